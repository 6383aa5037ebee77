"""The tool networks on a GPU give the masks of the CPU, independent of concurrent work."""

from __future__ import annotations

import threading

import numpy as np
import pytest
import torch

from gsplat_core.endoscope.reduced import averaged
from gsplat_core.endoscope.tool_network_torch import PRIORITY, TorchToolNetwork
from gsplat_core.endoscope.tools import (
    INPUT_PX,
    NETWORK,
    ROUND_INPUT_PX,
    ROUND_INPUTS,
    ROUND_NETWORK,
    NetworkToolFinder,
    features,
)
from gsplat_core.io.recordings import open_recording
from gsplat_core.rendering.alpha import CapturedSequence, GraphMemory
from tests.gsplat_core.endoscope.tool_pictures import in_round_view, tissue, with_rod

INPUTS = {NETWORK: (INPUT_PX, 5), ROUND_NETWORK: (ROUND_INPUT_PX, ROUND_INPUTS)}
BOUND = 1e-4
"""Largest difference of logits, and largest share of pixels with another mask."""

both_networks = pytest.mark.parametrize("path", INPUTS, ids=["full", "round"])


def inputs(path, count=3):
    (width, height), planes = INPUTS[path]
    rng = np.random.default_rng(0)
    drawn = [features(averaged(image, (width, height)), planes) for image in pictures()]
    return drawn + [rng.normal(size=(1, planes, height, width)).astype(np.float32) for _ in range(count)]


def pictures():
    rod = with_rod(256, 320)[0]
    return [rod, tissue(256, 320), in_round_view(rod)[0]]


@pytest.fixture(scope="module")
def finder(gpu):
    return NetworkToolFinder(device="cuda")


@both_networks
def test_tool_network_logits_equal_cpu(gpu, path):
    network, on_cpu = TorchToolNetwork(path, gpu), TorchToolNetwork(path, torch.device("cpu"))
    for planes in inputs(path):
        wanted = on_cpu.logits(planes)
        assert np.ptp(wanted) > 1
        np.testing.assert_allclose(network.logits(planes), wanted, rtol=0, atol=BOUND)


def test_tool_network_masks_of_drawn_images_equal_cpu(finder):
    on_cpu = NetworkToolFinder()
    for image in pictures():
        assert (finder.find(image) != on_cpu.find(image)).mean() <= BOUND


@pytest.mark.recordings
@pytest.mark.parametrize("name", ["heart", "cutting", "others/colonoscopy_a"])
def test_tool_network_masks_of_recordings_equal_cpu(recordings_dir, finder, name):
    on_cpu = NetworkToolFinder()
    for frame in open_recording(recordings_dir / name, max_frames=10):
        assert (finder.find(frame.image) != on_cpu.find(frame.image)).mean() <= BOUND


@both_networks
def test_tool_network_deterministic_across_order_and_instances(gpu, path):
    first, second = TorchToolNetwork(path, gpu), TorchToolNetwork(path, gpu)
    given = inputs(path)
    wanted = [first.logits(planes).tobytes() for planes in given]
    assert len(set(wanted)) == len(given)
    for _ in range(20):
        assert [first.logits(planes).tobytes() for planes in reversed(given)] == wanted[::-1]
    assert [second.logits(planes).tobytes() for planes in given] == wanted


def busy(stop, started):
    """Launch kernels and allocate memory until `stop`. During a capture, CUDA forbids to wait for the whole device, and torch to use its generator."""
    values = torch.rand(1024, 1024, device="cuda")
    while not stop.is_set():
        values = (values @ values).sigmoid() + torch.ones_like(values)
        torch.cuda.current_stream().synchronize()
        started.set()


def test_tool_network_masks_independent_of_threads_and_streams(finder):
    """Networks are also captured while another thread launches kernels."""
    wanted = [finder.find(image).tobytes() for image in pictures()]
    stop, started = threading.Event(), threading.Event()
    other = threading.Thread(target=busy, args=(stop, started))
    other.start()
    try:
        assert started.wait(300)
        found = []

        def work():
            own = NetworkToolFinder(device="cuda")
            with torch.cuda.stream(torch.cuda.Stream()):
                for _ in range(50):
                    found.append([each.find(image).tobytes() for each in (finder, own) for image in pictures()])

        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
    finally:
        stop.set()
        other.join()
    assert found == [wanted * 2] * 50


def test_tool_network_allocates_memory_once(gpu):
    network = TorchToolNetwork(NETWORK, gpu)
    planes = inputs(NETWORK)[0]
    network.logits(planes)
    torch.cuda.synchronize()
    before = torch.cuda.memory_stats()["allocation.all.allocated"]
    for _ in range(5):
        network.logits(planes)
    assert torch.cuda.memory_stats()["allocation.all.allocated"] == before


def test_tool_network_graph_captured_with_priority(gpu):
    """The first run loads the kernels, the second one is captured."""
    priorities = []

    class Watched(TorchToolNetwork):
        def _run(self):
            priorities.append(torch.cuda.current_stream().priority)
            super()._run()

    network = Watched(NETWORK, gpu)
    network.logits(inputs(NETWORK)[0])
    assert priorities == [PRIORITY, PRIORITY]
    priorities.clear()
    memory, values = GraphMemory(gpu), torch.zeros(1, device=gpu)

    def sequence():
        priorities.append(torch.cuda.current_stream().priority)
        values.add_(1)

    CapturedSequence(sequence, gpu, memory, warm_up=True)
    CapturedSequence(sequence, gpu, memory, warm_up=False, priority=PRIORITY)
    assert priorities == [0, 0, PRIORITY]
