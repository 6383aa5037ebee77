"""Errors if the Holoscan SDK cannot be loaded."""

from __future__ import annotations

import importlib.util

import pytest

from operators.errors import EngineMissing
from operators.graph import sdk


def hide(monkeypatch, *hidden):
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name in hidden else find_spec(name, *rest)
    )


def test_missing_sdk_error_names_pip_extra(monkeypatch):
    hide(monkeypatch, "holoscan")
    with pytest.raises(EngineMissing, match=r"not installed; install it with: pip install 'intrasplat\[holoscan\]'"):
        sdk.load_sdk()


def test_missing_cuda_runtime_error_names_library_and_pip_extra(monkeypatch):
    hide(monkeypatch, "nvidia")

    def cannot(name, mode=0):
        raise OSError(f"{name}: cannot open shared object file")

    monkeypatch.setattr(sdk.ctypes, "CDLL", cannot)
    with pytest.raises(
        EngineMissing, match=r"libcudart.so.13 of the package nvidia-cuda-runtime.*intrasplat\[holoscan\]"
    ):
        sdk._preload_cudart()


def test_broken_sdk_error_includes_import_error(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *rest: object())
    monkeypatch.setattr(sdk, "_preload_cudart", lambda: None)

    def broken(name):
        raise ImportError("libfoo.so: undefined symbol")

    monkeypatch.setattr(sdk.importlib, "import_module", broken)
    with pytest.raises(EngineMissing, match=r"cannot be loaded.*undefined symbol"):
        sdk.load_sdk()
