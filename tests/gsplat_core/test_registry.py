"""Implementations chosen by name."""

from __future__ import annotations

import json
import sys

import pytest

from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.registry import Registry


def test_registry_keeps_order_and_entries():
    registry = Registry[int]("number", {"two": 2})
    registry.add("one", 1)
    assert list(registry) == ["two", "one"] and len(registry) == 2
    assert registry["one"] == 1 and "two" in registry and "three" not in registry


def test_registry_imports_entry_on_first_use(monkeypatch):
    monkeypatch.delitem(sys.modules, "json.tool", raising=False)
    registry = Registry[object]("tool", {"tool": "json.tool:main", "loads": "json:loads"})
    assert list(registry) == ["tool", "loads"] and "json.tool" not in sys.modules
    assert registry["loads"] is json.loads
    assert callable(registry["tool"]) and "json.tool" in sys.modules


def test_registry_unknown_name_error_lists_known_names():
    registry = Registry[int]("renderer", {"alpha": 1, "points": 2})
    with pytest.raises(InvalidSetting, match=r"unknown renderer 'alhpa'; known are alpha, points"):
        registry["alhpa"]
    with pytest.raises(InvalidSetting, match="unknown renderer"):
        registry.remove("alhpa")
    registry.remove("alpha")
    assert list(registry) == ["points"]


def test_registry_rejects_duplicate_name():
    registry = Registry[int]("renderer", {"alpha": 1})
    with pytest.raises(InvalidInput, match="'alpha'"):
        registry.add("alpha", 2)
    assert registry["alpha"] == 1
