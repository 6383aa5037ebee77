"""Fixtures for all tests."""

from __future__ import annotations

import gc
import os
import signal
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.missing import missing

# Shells start background jobs with SIGINT ignored, which programs interrupted by tests would
# inherit.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_configure() -> None:
    """Restore the default SIGINT handler, also for child processes; shells start background jobs with SIGINT ignored."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_finish() -> None:
    """Exclude the imported modules and collected tests from garbage collections, which would traverse them hundreds of times."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session")
def recordings_dir() -> Path:
    """Return the folder of real recordings. If it is absent, skip the test; fail in CI."""
    default = Path(__file__).resolve().parents[1].parent / "shared" / "recordings"
    folder = Path(os.environ.get("INTRASPLAT_RECORDINGS") or default)
    if not folder.is_dir():
        missing(f"no real recordings in {folder}; set INTRASPLAT_RECORDINGS to their folder")
    return folder


@pytest.fixture(scope="session")
def gpu() -> torch.device:
    """Return the GPU to test on, if torch sees one and the CUDA kernels are built.

    Otherwise the test is skipped with the reason, or fails if FAIL_WITHOUT_CUDA=1.
    """
    from gsplat_core.ops import native

    why = None if torch.cuda.is_available() else f"torch {torch.__version__} sees no GPU"
    if why is None and native.CUDA_MISSING is not None:
        why = f"the CUDA kernels are {native.CUDA_MISSING}"
    if why is not None:
        if os.environ.get("FAIL_WITHOUT_CUDA") == "1":
            pytest.fail(why)
        pytest.skip(why)
    return torch.device("cuda", 0)


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
def device(request: pytest.FixtureRequest) -> torch.device:
    """Parametrise a test over the CPU and, if available, the GPU."""
    return request.getfixturevalue("gpu") if request.param == "cuda" else torch.device("cpu")


@pytest.fixture
def rng() -> np.random.Generator:
    """Return a NumPy generator with a fixed seed."""
    return np.random.default_rng(0)


@pytest.fixture
def generator() -> torch.Generator:
    """Return a torch CPU generator with a fixed seed."""
    return torch.Generator().manual_seed(0)


@pytest.fixture
def sdk() -> None:
    """Require the optional Holoscan SDK.

    Without it the test is skipped, or fails if INTRASPLAT_REQUIRE_HOLOSCAN=1.
    """
    from operators.errors import EngineMissing
    from operators.graph.sdk import load_sdk

    try:
        load_sdk()
    except EngineMissing as error:
        if os.environ.get("INTRASPLAT_REQUIRE_HOLOSCAN") == "1":
            pytest.fail(f"the Holoscan SDK is required here: {error}")
        pytest.skip(str(error))
