r"""List the CUDA kernels that the tests launch and miss, and select a few tests that launch all reached kernels.

    python benchmarks/gpu_kernels_reached.py                                     # all CUDA tests; fails if a kernel is not launched
    xargs -d '\n' python benchmarks/gpu_kernels_reached.py < benchmarks/sanitized_tests.txt  # these tests alone
    python benchmarks/gpu_kernels_reached.py --cover benchmarks/sanitized_tests.txt

With `--cover FILE` the selected tests are written to FILE, for `gpu_sanitize.sh`. They launch every kernel with about as much work as any quick test does. Tests that
capture CUDA graphs are excluded, because two tools of compute-sanitizer disable torch's memory cache, which capturing needs. Other arguments are passed to pytest.
Needs a GPU, cuobjdump, and kernels built for that GPU alone.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
from collections.abc import Generator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
import torch
from torch.profiler import ProfilerActivity, profile

ROOT = Path(__file__).resolve().parent.parent
LIBRARY = ROOT / "gsplat_core" / "gsplat_core_cuda.so"
TESTS = "tests/gsplat_core/cuda"
QUICK_US = 3000.0
"""Longest GPU time of a test to run under a sanitizer, which multiplies it by 100 or more."""
MUCH = 0.5
"""A test counts as heavy use of a kernel from this share of the kernel's longest time in a quick test on."""
SETUP_US = 1000.0
"""Approximate overhead of a test under a sanitizer, in the same unit."""


@dataclass
class Launched:
    """Kernels launched by one test."""

    kernels_us: dict[str, float] = field(default_factory=dict)
    records_graphs: bool = False

    @property
    def total_us(self) -> float:
        return sum(self.kernels_us.values())


@dataclass
class Watch:
    """Pytest plugin that records the kernels each test launches."""

    tests: dict[str, Launched] = field(default_factory=dict)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Generator[None, object, object]:
        launched = self.tests[item.nodeid] = Launched()
        begin = torch.cuda.CUDAGraph.capture_begin

        def noted(graph: torch.cuda.CUDAGraph, *arguments: object, **options: object) -> None:
            launched.records_graphs = True
            begin(graph, *arguments, **options)

        torch.cuda.CUDAGraph.capture_begin = noted
        try:
            with profile(activities=[ProfilerActivity.CUDA], acc_events=True) as profiler:
                result = yield
                torch.cuda.synchronize()
        finally:
            torch.cuda.CUDAGraph.capture_begin = begin
        for event in profiler.key_averages():
            name = plain(event.key)
            launched.kernels_us[name] = launched.kernels_us.get(name, 0.0) + event.device_time_total
        return result


def plain(name: str) -> str:
    """Return a demangled name without spaces and result type."""
    return re.sub(r"^void|\s", "", name)


def kernels_of(library: Path) -> set[str]:
    """Return all kernels of the library except CUB's and the probe of `cuda_build.cu`, which is never launched."""
    usage = subprocess.run(["cuobjdump", "-res-usage", library], check=True, capture_output=True, text=True).stdout
    mangled = "\n".join(sorted(set(re.findall(r"\b_Z\w+", usage))))
    names = subprocess.run(["c++filt"], input=mangled, check=True, capture_output=True, text=True).stdout
    return {plain(name) for name in names.splitlines() if "cub::" not in name and "::probe()" not in name}


def cover(tests: dict[str, Launched], kernels: set[str]) -> list[str]:
    """Select few, quick tests that together use every kernel heavily (greedy set cover)."""
    eager = {name: test for name, test in tests.items() if not test.records_graphs}
    most: dict[str, float] = {}
    for test in sorted(eager.values(), key=lambda test: test.total_us):
        for kernel in kernels & test.kernels_us.keys():
            # Of a kernel that no quick test launches, the quickest one counts.
            if test.total_us <= QUICK_US or kernel not in most:
                most[kernel] = max(most.get(kernel, 0.0), test.kernels_us[kernel])
    much = {
        name: {kernel for kernel, us in test.kernels_us.items() if kernel in most and us >= MUCH * most[kernel]}
        for name, test in eager.items()
    }
    chosen: list[str] = []
    missing = set(most)
    while missing:
        best = max(eager, key=lambda name: len(much[name] & missing) / (SETUP_US + eager[name].total_us))
        missing -= much[best]
        chosen.append(best)
    return sorted(chosen)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cover", type=Path, metavar="FILE", help="write the few tests to FILE")
    options, for_pytest = parser.parse_known_args()
    chosen = any(not argument.startswith("-") for argument in for_pytest)
    watch = Watch()
    failed = pytest.main(["-q", "-m", "cuda", *for_pytest, *([] if chosen else [TESTS])], plugins=[watch])
    ours = kernels_of(LIBRARY)
    launched = ours.intersection(*[{kernel for test in watch.tests.values() for kernel in test.kernels_us}])
    print(f"{len(launched)} of {len(ours)} kernels were launched; not launched:")
    print(*(sorted(ours - launched) or ["none"]), sep="\n")
    if options.cover is not None:
        few = cover(watch.tests, ours)
        options.cover.write_text("\n".join(few) + "\n")
        print(f"{len(few)} of {len(watch.tests)} tests are enough")
    return int(bool(failed) or launched != ours)


if __name__ == "__main__":
    sys.exit(main())
