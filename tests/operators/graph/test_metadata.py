"""Metadata of several messages of one compute are merged by policy."""

from __future__ import annotations

import numpy as np
import pytest

from operators.errors import MetadataConflict
from operators.graph.operator import MetadataPolicy, merge_metadata


@pytest.mark.parametrize(("policy", "kept"), [(MetadataPolicy.UPDATE, 2), (MetadataPolicy.REJECT, 1)])
def test_merge_metadata_keeps_value_by_policy(policy, kept):
    into = {"seq": 1, "own": 5}
    merge_metadata(into, {"seq": 2, "new": 7}, policy)
    assert into == {"seq": kept, "own": 5, "new": 7}


@pytest.mark.parametrize(
    ("one", "other", "equal"), [(1, 1, True), ("a", "a", True), ((1, 2), (1, 2), True), (1, 2, False), ("1", 1, False)]
)
def test_merge_metadata_raise_policy_refuses_different_values(one, other, equal):
    into = {"seq": one}
    if equal:
        merge_metadata(into, {"seq": other, "new": 3}, MetadataPolicy.RAISE)
        assert into == {"seq": one, "new": 3}
    else:
        with pytest.raises(MetadataConflict, match="metadata 'seq'"):
            merge_metadata(into, {"seq": other}, MetadataPolicy.RAISE)


def test_merge_metadata_compares_arrays_by_identity():
    array = np.zeros(2)
    merge_metadata({"a": array}, {"a": array}, MetadataPolicy.RAISE)
    for one, other in ((array, array.copy()), (array, 1), (1, array)):
        with pytest.raises(MetadataConflict):
            merge_metadata({"a": one}, {"a": other}, MetadataPolicy.RAISE)
