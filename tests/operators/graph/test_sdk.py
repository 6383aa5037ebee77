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


def test_a_missing_sdk_names_the_extra(monkeypatch):
    hide(monkeypatch, "holoscan")
    with pytest.raises(EngineMissing, match=r"not installed; install it with: pip install 'intrasplat\[holoscan\]'"):
        sdk.load_sdk()


def test_a_missing_cuda_runtime_names_the_library_and_the_extra(monkeypatch):
    hide(monkeypatch, "nvidia")

    def cannot(name, mode=0):
        raise OSError(f"{name}: cannot open shared object file")

    monkeypatch.setattr(sdk.ctypes, "CDLL", cannot)
    with pytest.raises(
        EngineMissing, match=r"libcudart.so.13 of the package nvidia-cuda-runtime.*intrasplat\[holoscan\]"
    ):
        sdk._preload_cudart()


def test_a_broken_sdk_says_what_the_loader_said(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *rest: object())
    monkeypatch.setattr(sdk, "_preload_cudart", lambda: None)

    def broken(name):
        raise ImportError("libfoo.so: undefined symbol")

    monkeypatch.setattr(sdk.importlib, "import_module", broken)
    with pytest.raises(EngineMissing, match=r"cannot be loaded.*undefined symbol"):
        sdk.load_sdk()
