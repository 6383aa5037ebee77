"""Nothing that is not ours is ever written over."""

from __future__ import annotations

import pytest

from operators.errors import OutputFolderInUse
from operators.output_folder import MARKER, check_output_folder, claim_output_folder


def test_a_new_and_an_empty_folder_become_ours(tmp_path):
    assert claim_output_folder(tmp_path / "a" / "b", "replay") is False
    (tmp_path / "empty").mkdir()
    assert claim_output_folder(tmp_path / "empty", "replay") is False
    assert claim_output_folder(tmp_path / "empty", "replay") is True, "the second time it is an earlier run"


def test_checking_changes_nothing(tmp_path):
    assert check_output_folder(tmp_path / "new") is False
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("marker", [None, "not json", "[]", '{"format": "something else"}'])
def test_a_folder_of_somebody_else_is_refused_and_untouched(tmp_path, marker):
    (tmp_path / "thesis.tex").write_text("years of work")
    if marker is not None:
        (tmp_path / MARKER).write_text(marker)
    with pytest.raises(OutputFolderInUse, match=r"not made by intrasplat .*thesis\.tex.*choose another --out"):
        claim_output_folder(tmp_path, "replay")
    assert (tmp_path / "thesis.tex").read_text() == "years of work"


def test_a_file_is_not_a_folder(tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(OutputFolderInUse, match="is a file"):
        claim_output_folder(tmp_path / "file", "replay")
