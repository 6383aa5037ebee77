"""Analysis of live frames in a child process, where no other thread holds the interpreter lock.

Training runs Python at the same time as the analysis. In one process each of the analysis's many short calls of NumPy and
OpenCV would have to wait for the interpreter lock. With a process, the parent waits once per frame. Pictures travel in
shared memory. The process does not import torch.
"""

from __future__ import annotations

import logging
import os
import signal
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_core.io.frame_codec import InvalidMessage, decode, encode
from gsplat_core.scene.frames import Frame
from operators.checks import PICTURE_STAGES, OrdinaryStream, PictureStagesOp, StageOp, new_stages
from operators.choices import Policy
from operators.low_latency import low_latency
from operators.out_of_body import WITHHELD, OutOfBodyGateOp, withheld
from operators.outcome import OutcomeBuilder
from operators.side_by_side import Chains
from operators.sources.process import (
    IGNORED_SIGNALS,
    MOST_BYTES,
    ChildLost,
    ChildProcess,
    FrameReader,
    FrameWriter,
    ToParent,
    log_record,
    message,
    parsed,
)
from operators.tool_mask import new_tool_mask

log = logging.getLogger(__name__)

SIDE_STAGE = "highlights"
"""A stage with no dependencies; runs concurrently with the other picture stages."""
START_WITHIN_S = 20.0
"""Time limit for the process to load its libraries, in seconds."""
ANSWER_WITHIN_S = 2.0
"""Time limit for the analysis of one frame, in seconds."""
ARRAYS = ("image", "right_image", "mask", "loss_mask", "rehearsal_mask")
"""Arrays of a frame that the analysis may change, all uint8."""
TEXTS = ("withheld", "new_scene")
UNSENT = ("depth", "depth_confidence", "pose")
"""Arrays of a frame that the analysis does not read."""
WARM_UP_SIZE = (512, 640, 3)


def new_chains(tool_mask: str, out_of_body: Policy, stream: OrdinaryStream, fragment: Any = None) -> Chains:
    """Return the chains that detect tools, highlights and faults of a picture.

    Args:
        tool_mask: tool detector, a name in `TOOL_MASKS`.
        out_of_body: policy for pictures from outside of the body.
        stream: state shared with the stages that use the tool mask.
        fragment: the graph.
    """
    others = [name for name in PICTURE_STAGES if name != SIDE_STAGE]
    picture_stages = new_stages(PICTURE_STAGES, without=[SIDE_STAGE])
    return Chains(
        gate=[OutOfBodyGateOp(fragment, name="out_of_body", policy=out_of_body)],
        first=[PictureStagesOp(fragment, name="picture", stages=picture_stages, stream=stream)],
        beside=[
            [new_tool_mask(fragment, tool_mask)],
            [StageOp(fragment, name=SIDE_STAGE, stages=new_stages(PICTURE_STAGES, without=others))],
        ],
    )


class Server:
    """Analysis in the child process."""

    def __init__(self, connection: Connection, frames_fd: int, findings_fd: int) -> None:
        self.connection = connection
        self._frames, self._findings = FrameReader(frames_fd), FrameWriter(findings_fd)

    def send(self, kind: str, **content: object) -> None:
        """Send a message to the parent."""
        self.connection.send_bytes(message(kind, **content))

    def serve(self, asked: Mapping[str, Any]) -> None:
        """Analyse frames until the parent requests the counts."""
        stream = OrdinaryStream()
        chains = new_chains(asked["tool_mask"], asked["out_of_body"], stream)
        stream.join(asked["members"] - stream.members)
        chains.start()
        _warm_up(chains)
        chains.stop()
        # Discard the state and counts of the warm-up.
        chains.start()
        with low_latency():
            self.send("ready")
            while (received := parsed(self.connection.recv_bytes(MOST_BYTES)))["kind"] == "frame":
                frame = decode(self._frames.read(received["offset"], received["sizes"]))
                self._answer(frame, chains.decide(frame), stream)
        outcome = OutcomeBuilder()
        chains.contribute(outcome)
        parts = {kind.__name__: asdict(part) for kind, part in outcome.parts.items()}  # type: ignore[call-overload]
        self.send("counts", parts=parts, notes=outcome.notes)

    def _answer(self, frame: Frame, decided: Frame, stream: OrdinaryStream) -> None:
        content: dict[str, Any] = {"stream": stream.as_json(), "pts_ns": decided.pts_ns}
        content |= {name: getattr(decided, name) for name in TEXTS}
        changed = {name: array for name in ARRAYS if (array := getattr(decided, name)) is not getattr(frame, name)}
        if changed and decided.withheld != WITHHELD:
            pieces: list[bytes | memoryview] = [
                np.ascontiguousarray(array, np.uint8).reshape(-1).data for array in changed.values()
            ]
            if not self._findings.fits(pieces):
                self._findings.grow(pieces)
            content |= {"arrays": list(changed), **self._findings.write(0, pieces)}
        self.send("found", **content)


def _warm_up(chains: Chains) -> None:
    """Run the chains on random pictures, so that the first frame does not wait for libraries."""
    random = np.random.default_rng(0)
    for seq in range(3):
        chains.decide(Frame(seq, seq * 33_000_000, random.integers(0, 256, WARM_UP_SIZE, np.uint8)))


def serve(connection_fd: int, frames_fd: int, findings_fd: int) -> None:
    """Analyse the frames of the parent process; the main function of the child process.

    It ends when the parent closes the connection. It ignores signals sent to the process group, because the parent
    controls its lifetime.

    Args:
        connection_fd: file descriptor of the connection to the parent.
        frames_fd: file descriptor of the shared memory with frames.
        findings_fd: file descriptor of the shared memory for findings.
    """
    for number in IGNORED_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    server = Server(Connection(connection_fd), frames_fd, findings_fd)
    logging.getLogger().addHandler(ToParent(server.send))
    logging.getLogger().setLevel(logging.INFO)
    with suppress(EOFError, OSError):  # the parent has closed the connection
        try:
            server.serve(parsed(server.connection.recv_bytes(MOST_BYTES)))
        except (EOFError, OSError):
            raise
        except Exception as error:  # noqa: BLE001 - sent to the parent process, which reports it
            server.send("failed", error=f"{type(error).__name__}: {error}"[:2000])
    os._exit(0)


class AnalysisProcess:
    """Chains that run in a child process. If the process fails, the chains of this process replace it."""

    def __init__(self, tool_mask: str, out_of_body: Policy, stream: OrdinaryStream, fragment: Any = None) -> None:
        """Store the settings; see `new_chains`. The process runs from `start` to `stop`."""
        self._local = new_chains(tool_mask, out_of_body, stream, fragment)
        self._asked = {"tool_mask": tool_mask, "out_of_body": out_of_body}
        self._stream = stream
        self._process: ChildProcess | None = None
        self._frames: FrameWriter | None = None
        self._replaced = False
        self._counts: Mapping[str, Any] | None = None
        self._failure: str | None = None

    def start(self) -> None:
        """Start the process and wait until it is ready."""
        self._counts, self._failure, self._replaced = None, None, False
        process = ChildProcess(
            "operators.analysis_process:serve", {**self._asked, "members": self._stream.members}, memories=2
        )
        self._process, self._frames = process, FrameWriter(process.memory_fds[0])
        self._findings = FrameReader(process.memory_fds[1])
        try:
            self._received("ready", START_WITHIN_S)
        except ChildLost as error:
            self._replace(f"it did not start: {error}")

    def stop(self) -> None:
        """Collect the counts and end the process."""
        if self._replaced:
            self._local.stop()
        if self._process is None:
            return
        try:
            self._process.send("finish")
            self._counts = self._received("counts", ANSWER_WITHIN_S)
        except ChildLost as error:
            self._failure = f"its counts are lost: {error}"
        self._end()

    def decide(self, frame: Frame) -> Frame:
        """Return the frame with the findings in its fields."""
        if self._process is not None:
            try:
                return self._found(frame)
            except (ChildLost, InvalidMessage) as error:
                self._replace(f"frame {frame.seq}: {error}")
        return self._local.decide(frame)

    def contribute(self, outcome: OutcomeBuilder) -> None:
        """Add the counts of the process to the outcome of the run, and a note if the process failed."""
        if self._failure is not None:
            outcome.note(
                f"the process that analyses frames failed ({self._failure}); checks before that are not counted"
            )
        if self._counts is None:
            self._local.contribute(outcome)
            return
        # The idle chains of this process contribute parts of the same classes.
        idle = OutcomeBuilder()
        self._local.contribute(idle)
        kinds = {kind.__name__: kind for kind in idle.parts}
        for name, values in self._counts["parts"].items():
            outcome.add(kinds[name](**values))
        for note in self._counts["notes"]:
            outcome.note(note)

    def _found(self, frame: Frame) -> Frame:
        assert self._process is not None and self._frames is not None
        pieces = encode(frame.with_fields(right_camera=None, **dict.fromkeys(UNSENT)))
        if not self._frames.fits(pieces):
            self._frames.grow(pieces)
        self._process.send("frame", **self._frames.write(0, pieces))
        found = self._received("found", ANSWER_WITHIN_S)
        self._stream.take_over(found["stream"])
        if found["withheld"] == WITHHELD:
            return withheld(frame).with_fields(pts_ns=found["pts_ns"])
        arrays: dict[str, NDArray[np.uint8]] = {}
        if "arrays" in found:
            pieces_found = self._findings.read(found["offset"], found["sizes"])
            for name, piece in zip(found["arrays"], pieces_found, strict=True):
                colour = name.endswith("image")
                arrays[name] = np.frombuffer(piece, np.uint8).reshape(frame.image.shape[: 3 if colour else 2])
        return frame.with_fields(pts_ns=found["pts_ns"], **{name: found[name] for name in TEXTS}, **arrays)

    def _received(self, kind: str, timeout_s: float) -> dict[str, Any]:
        """Return the next message of a kind; log records before it. Raises ChildLost."""
        assert self._process is not None
        while (received := self._process.receive(timeout_s)) is not None:
            if received["kind"] == kind:
                return received
            if received["kind"] != "log":
                raise ChildLost(str(received.get("error", received["kind"])))
            log_record(received)
        raise ChildLost(f"no answer within {timeout_s:g} s")

    def _replace(self, reason: str) -> None:
        """End the process and use the chains of this process from now on."""
        log.warning("the process that analyses frames failed (%s); they are analysed in this process", reason)
        self._failure, self._replaced = reason, True
        self._end(kill=True)
        self._local.start()

    def _end(self, *, kill: bool = False) -> None:
        process, self._process, self._frames = self._process, None, None
        assert process is not None
        self._findings.close()
        if kill:
            process.kill()
        else:
            process.end()
