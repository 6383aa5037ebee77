"""Exports and renderings of models as files: formats, the program that makes a file, its limits in the service, and the cache of the files.

The service runs the program `python -m services.exports.files FOLDER FILE --format glb` for each new file, so this module imports torch only in the
functions that need it. Exit code 0: the file was written. Exit code 2: the export was refused, with the reason on standard error. The cache finds a
file by the digest of its input, and evicts the oldest.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import os
import resource
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Literal, get_args

from gsplat_core.errors import InvalidSetting, UserError
from gsplat_core.io.exports.formats import FORMATS, ExportFormat, ExportWish
from gsplat_core.value_ranges import check_seen_at
from operators.settings import RenderOptions
from services.errors import ExportBusy, ExportFailed, ExportRefused
from services.private_files import keep_files_private
from services.registry.bundle_file import SUFFIX, pack

PictureView = Literal["recorded", "orbit", "stereo"]
PICTURES: Mapping[str, ExportFormat] = {
    each.name: each for each in (ExportFormat("png", ".png", "image/png"), ExportFormat("mp4", ".mp4", "video/mp4"))
}
"""Formats of renderings: a picture at one time, and a video over the model's time window."""


@dataclass(frozen=True)
class RenderWish:
    """Rendering of a model that a client requests: format, viewpoint and size.

    Raises:
        InvalidSetting: if the fields do not fit together.
    """

    format: ExportFormat
    options: RenderOptions
    view: PictureView = "recorded"
    time_s: float | None = None
    """Time of a picture in seconds; None selects the end of the model's window."""

    def __post_init__(self) -> None:
        if self.view not in get_args(PictureView):
            raise InvalidSetting(f"view is {self.view!r:.60}; choose {', '.join(get_args(PictureView))}")
        if self.format.name != "png" and self.time_s is not None:
            raise InvalidSetting("a video shows the whole time window of the model; leave the time out, or take png")

    def times_in(self, window_s: tuple[float, float]) -> list[float]:
        """Return the time of a picture, or the ends of a video.

        Raises:
            InvalidSetting: if the requested time is outside the window.
        """
        if self.format.name != "png":
            return list(window_s)
        time_s = window_s[1] if self.time_s is None else self.time_s
        check_seen_at(time_s, window_s)
        return [time_s]


ISPLAT = ExportFormat("isplat", SUFFIX, "application/octet-stream")
"""Format of the complete model with its deformation. Unlike the other formats it needs no point in time."""
ALL: Mapping[str, ExportFormat] = {**FORMATS, ISPLAT.name: ISPLAT}
Wish = ExportWish | RenderWish


def arguments_of(wish: Wish) -> list[str]:
    """Return the command line arguments of the export program."""
    if isinstance(wish, RenderWish):
        wanted = {"view": wish.view, "time_s": wish.time_s, "options": wish.options.chosen()}
        return [f"--format={wish.format.name}", f"--render={json.dumps(wanted, sort_keys=True)}"]
    given = {"--time": wish.time_s, "--times": wish.times}
    named = [f"{name}={value!r}" for name, value in given.items() if value is not None]
    return [f"--format={wish.format.name}", *named]


PROGRAM = (sys.executable, "-P", "-m", "services.exports.files")
REFUSED = 2
"""Exit code of the export program if the model cannot be exported to the format."""
MOST_S = 300.0
PASSED_ON = (
    "PATH", "PYTHONPATH", "LD_LIBRARY_PATH", "LANG", "LC_ALL", "TMPDIR", "HOME", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS",
)  # fmt: skip
"""Environment variables passed to the program; none holds credentials."""


class ExportPrograms:
    """Runs export programs for a limited time each, and kills the running ones on `end`. Thread-safe."""

    def __init__(self, program: tuple[str, ...] = PROGRAM, most_s: float = MOST_S) -> None:
        self._program, self._most_s = program, most_s
        self._lock = threading.Lock()
        self._running: set[subprocess.Popen[bytes]] = set()
        self._ended = False

    def make(self, folder: Path, file: Path, wish: Wish) -> None:
        """Create one file from an unpacked model; blocks.

        Raises:
            ExportRefused: if the model cannot be exported to the format.
            ExportFailed: if the program fails.
        """
        command = [*self._program, str(folder), str(file), *arguments_of(wish)]
        environment = {name: os.environ[name] for name in PASSED_ON if name in os.environ}
        with tempfile.TemporaryFile() as said:
            try:
                process = subprocess.Popen(
                    command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=said,
                    env={**environment, "CUDA_VISIBLE_DEVICES": ""}, start_new_session=True,
                )  # fmt: skip
            except OSError as error:
                raise ExportFailed(f"the export cannot be started: {error.strerror or error}; try again") from error
            with self._counted(process):
                try:
                    code = process.wait(self._most_s)
                except subprocess.TimeoutExpired:
                    raise ExportFailed(
                        f"the export took longer than {self._most_s:g} s; ask for fewer times, frames or samples, or a smaller picture"
                    ) from None
                finally:
                    _kill(process)
            said.seek(max(0, said.seek(0, os.SEEK_END) - 2000))
            words = said.read().decode(errors="replace").strip().splitlines() or ["it said nothing"]
        if code == REFUSED:
            raise ExportRefused(words[-1][:500])
        if code != 0:
            raise ExportFailed(f"the export ended with code {code}: {words[-1][:300]}; the server's log may say more")

    def end(self) -> None:
        """Kill running export programs. Programs that are started later are killed immediately after their start."""
        with self._lock:
            self._ended = True
            for process in self._running:
                _kill(process)

    @contextlib.contextmanager
    def _counted(self, process: subprocess.Popen[bytes]) -> Iterator[None]:
        with self._lock:
            self._running.add(process)
            if self._ended:
                _kill(process)
        try:
            yield
        finally:
            with self._lock:
                self._running.discard(process)


def _kill(process: subprocess.Popen[bytes]) -> None:
    """Kill the process group of a program that leads its own session. A reaped process is skipped,
    because its id may be reused."""
    if process.poll() is None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


REVISION = 2
"""Version of the exporters' output. Increment when the same model gives other bytes."""
MOST_BYTES = 2 << 30
AT_ONCE = 1
MOST_WAITING = 8


@dataclass(frozen=True)
class Exported:
    """File of an export. `file` is open, so that it stays readable after an eviction from the cache."""

    file: BinaryIO
    sha256: str
    """SHA-256 of the file's bytes in hex."""
    size_bytes: int


class ExportCache:
    """Cache of export files in a folder. It creates missing exports one at a time. Thread-safe; one process per
    folder."""

    def __init__(
        self,
        folder: Path,
        *,
        most_bytes: int = MOST_BYTES,
        most_waiting: int = MOST_WAITING,
        programs: ExportPrograms | None = None,
    ) -> None:
        """Open the cache. The folder is created, and incomplete files are deleted."""
        self._folder, self._most_bytes = folder, most_bytes
        self._programs = programs or ExportPrograms()
        self._lock = threading.Lock()
        self._making: dict[str, threading.Lock] = {}
        self._turn = threading.BoundedSemaphore(AT_ONCE)
        self._waiting, self._most_waiting = 0, most_waiting
        self.made = 0
        """Number of created exports, without cache hits."""
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        for left in folder.glob("new-*"):
            shutil.rmtree(left)

    def get(self, digest: str, folder_of: Callable[[], Path], wish: Wish) -> Exported:
        """Return an export of the model with this digest, creating it if missing.

        Args:
            digest: digest of the model.
            folder_of: returns the folder of the unpacked model; called only if needed.
            wish: format and times.

        Raises:
            ExportRefused: if the model cannot be exported to the format.
            ExportBusy: if too many exports wait.
            ExportFailed: if the program or the disk fails.
        """
        key = hashlib.sha256(json.dumps([REVISION, digest, *arguments_of(wish)]).encode()).hexdigest()
        with self._queued(), self._lock_of(key):
            found = self._open(key)
            if found is None:
                with self._turn:
                    self._make(key, folder_of(), wish)
                found = self._open(key)
        if found is None:
            raise ExportFailed(f"the export is larger than the {self._most_bytes} bytes that are kept; ask for less")
        return found

    def close(self) -> None:
        """Kill the running export programs."""
        self._programs.end()

    @contextlib.contextmanager
    def _queued(self) -> Iterator[None]:
        with self._lock:
            if self._waiting >= self._most_waiting:
                raise ExportBusy(f"{self._waiting} exports wait already; ask again in a minute")
            self._waiting += 1
        try:
            yield
        finally:
            with self._lock:
                self._waiting -= 1

    @contextlib.contextmanager
    def _lock_of(self, key: str) -> Iterator[None]:
        """Hold the lock of an export while the block runs. A concurrent request for this export waits, and then
        finds the cached file."""
        with self._lock:
            lock = self._making.setdefault(key, threading.Lock())
        with lock:
            yield
        with self._lock:
            if not lock.locked():
                self._making.pop(key, None)

    def _open(self, key: str) -> Exported | None:
        with self._lock:
            try:
                about = json.loads((self._folder / f"{key}.json").read_text())
                file = open(self._folder / f"{key}.data", "rb")  # noqa: SIM115 - the caller closes the file
            except (FileNotFoundError, ValueError):
                return None
            os.utime(self._folder / f"{key}.data")
            return Exported(file, about["sha256"], about["size_bytes"])

    def _make(self, key: str, source: Path, wish: Wish) -> None:
        new = self._folder / f"new-{secrets.token_hex(8)}"
        try:
            new.mkdir(mode=0o700)
            file = new / f"model{wish.format.suffix}"
            self._programs.make(source, file, wish)
            with file.open("rb") as made:
                sha256 = hashlib.file_digest(made, "sha256").hexdigest()
            about = {"sha256": sha256, "size_bytes": file.stat().st_size}
            (new / "about").write_text(json.dumps(about))
            with self._lock:
                os.replace(file, self._folder / f"{key}.data")
                os.replace(new / "about", self._folder / f"{key}.json")
                self.made += 1
                self._evict()
        except OSError as error:
            raise ExportFailed(
                f"the export was not kept: {error.strerror or error}; free space and try again"
            ) from error
        finally:
            shutil.rmtree(new, ignore_errors=True)

    def _evict(self) -> None:
        """Evict the oldest files until the total size is within the limit. The caller holds the lock."""
        files = sorted(self._folder.glob("*.data"), key=lambda path: path.stat().st_mtime_ns)
        total = sum(path.stat().st_size for path in files)
        for path in files:
            if total <= self._most_bytes:
                return
            total -= path.stat().st_size
            path.with_suffix(".json").unlink(missing_ok=True)
            path.unlink()


NICENESS = 10
"""Nice value of an export; running streams have priority."""


def main(arguments: list[str] | None = None) -> int:
    """Create one export file. Return the exit code: 0, or `REFUSED` after a UserError."""
    keep_files_private()
    parser = argparse.ArgumentParser(prog="python -m services.exports.files", description="Export an unpacked model.")
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    parser.add_argument("file", type=Path, metavar="FILE")
    parser.add_argument("--format", choices=[*ALL, *PICTURES], required=True)
    parser.add_argument("--time", type=float)
    parser.add_argument("--times", type=int)
    parser.add_argument("--render", help="view, time and options of a rendering, as JSON")
    given = parser.parse_args(arguments)
    os.nice(NICENESS)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))  # a core file would contain patient data
    try:
        if given.format == ISPLAT.name:
            pack(given.folder, given.file)
        elif given.format in PICTURES:
            wanted = json.loads(given.render)
            options = RenderOptions(**wanted["options"])
            render(
                given.folder, given.file, RenderWish(PICTURES[given.format], options, wanted["view"], wanted["time_s"])
            )
        else:
            export(given.folder, given.file, ExportWish(ALL[given.format], given.time, given.times))
    except UserError as error:
        sys.stderr.write(f"{str(error).replace(f'{given.folder}/', '')}\n")
        return REFUSED
    return 0


def render(folder: Path, file: Path, wish: RenderWish) -> None:
    """Render a picture or a video. Imports here take seconds, and packing does not need them."""
    from operators.applications.render import ViewWish, render_model, render_picture
    from operators.sinks.video import write_png

    options = wish.options
    wanted: dict[str, Any] = {
        "scale": options.scale, "renderer": options.renderer, "options": options.renderer_options,
        "outputs": options.outputs, "view": ViewWish(wish.view),
    }  # fmt: skip
    if wish.format.name == "png":
        write_png(file, render_picture(folder, wish.time_s, **wanted))
    else:
        render_model(folder, file, fps=options.fps, **wanted)


def export(folder: Path, file: Path, wish: ExportWish) -> None:
    """Export to a format of other programs. Imports here take seconds, and packing does not need them."""
    from gsplat_core.io.bundle import load_bundle
    from gsplat_core.io.exports.export import export_model

    export_model(load_bundle(folder), file, wish)


if __name__ == "__main__":
    sys.exit(main())
