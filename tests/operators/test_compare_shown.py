"""Replayed pictures are compared with those that the session showed."""

from __future__ import annotations

from hashlib import sha256

from gsplat_core.io.sessions.records import ShownLine
from operators.graph import Application
from operators.metrics import CompareShownOp, ShownComparison
from tests.operators.conftest import make_rendered, run_once


def test_compare_shown_counts_and_names_first_different_picture() -> None:
    """The session showed frames 1, 2, 4, 5 and 7; the pictures of 4 and 5 differ."""

    def shown(seq: int, offset: int = 2) -> ShownLine:
        digest = sha256(make_rendered(seq, offset).image.tobytes()).hexdigest()
        return ShownLine(seq=seq, width_px=4, height_px=4, model_version=1, sha256=digest, tracks={})

    lines = [shown(1), shown(2), shown(4, 3), shown(5, 3), shown(7)]
    operator = CompareShownOp(Application(), name="compare", shown=lambda: iter(lines))
    operator.start()
    for seq in (1, 2, 3, 4, 5, 7, 8):
        run_once(operator, rendered=make_rendered(seq))
    assert operator.result == ShownComparison(same=3, different=2, first_different=4, not_shown=2)
