"""Rows of geometry scores: expected values, units and baselines."""

from __future__ import annotations

from types import SimpleNamespace as Facts
from typing import Any

import pytest

from services.reports.evaluation_html import geometry_lines, geometry_rows, geometry_section, scale_sentence

NOTHING: dict[str, Any] = {
    "frames": 1200, "depth": None, "normals": None, "views": [], "scaled_views": [], "tracking": None, "flow": None,
    "trajectory": None, "parts": None, "ray_depth": None, "ray_normals": None,
}  # fmt: skip


def geometry(**facts: Any) -> Any:
    return Facts(**(NOTHING | facts))


def rows(**facts: Any) -> list[tuple[str, str, str, bool]]:
    return [(row.what, row.value, row.baselines, row.relative) for row in geometry_rows(geometry(**facts))]


def depth(scale: float = 1.0) -> Any:
    return Facts(rmse_share=0.0123, scaled_rmse_share=0.01, level_rmse_share=0.2, plane_rmse_share=0.125, scale=scale)


def track(mm: float, px: float) -> Any:
    return Facts(median_mm=mm, mean_mm=mm + 0.5, median_px=px, mean_px=px + 0.25)


def view(ssim: float | None, psnr_db: float = 30.0) -> Any:
    return Facts(
        name="right", model=Facts(psnr_tissue_db=psnr_db, ssim=ssim), left=Facts(psnr_tissue_db=20.0),
        shifted=Facts(psnr_tissue_db=25.5),
    )  # fmt: skip


def test_geometry_rows_list_ray_depth_separately() -> None:
    normals = Facts(mean_deg=5, plane_mean_deg=12, level_mean_deg=None)
    found = rows(depth=depth(), ray_depth=depth(), normals=normals, ray_normals=normals)
    names = [what.split(",")[0] for what, *_ in found]
    assert names == [
        "Depth", "Depth after one scale", "Ray depth", "Ray depth after one scale", "Normals", "Normals of ray depth",
    ]  # fmt: skip


def test_geometry_without_measures_has_no_rows_and_section() -> None:
    assert rows() == []
    for report in (Facts(geometry=None), Facts(geometry=geometry())):
        assert geometry_section(report) == "" and geometry_lines(report) == []  # type: ignore[arg-type]


def test_depth_rows_have_both_plane_baselines() -> None:
    planes = "level plane 20.00 %, best-fit plane 12.50 %"
    assert rows(depth=depth()) == [
        ("Depth, root mean squared error, share of the median depth", "1.23 %", planes, False),
        ("Depth after one scale, root mean squared error, share of the median depth", "1.00 %", planes, True),
    ]


@pytest.mark.parametrize(
    ("level", "baselines"), [(None, "best-fit plane 12.4°"), (40.0, "level plane 40.0°, best-fit plane 12.4°")]
)
def test_normals_row_has_plane_baselines(level: float | None, baselines: str) -> None:
    normals = Facts(mean_deg=5.04, plane_mean_deg=12.41, level_mean_deg=level)
    assert rows(normals=normals) == [("Normals, mean angle", "5.0°", baselines, True)]


def test_scaled_view_row_appears_only_if_different() -> None:
    baselines = "left picture 20.00 dB, shifted 25.50 dB"
    first = ("View of the right camera", "30.00 dB, SSIM 0.9000", baselines, False)
    assert rows(views=[view(0.9)], scaled_views=[view(0.9)]) == [first]
    assert rows(views=[view(0.9)], scaled_views=[view(None, 31.0)]) == [
        first,
        ("View of the right camera after one scale", "31.00 dB", baselines, True),
    ]


def test_tracking_rows_have_no_motion_baseline() -> None:
    facts = Facts(model=track(1.0, 4.0), scaled=track(0.9, 3.0), still=track(2.0, 8.0))
    still = "no motion 2.00 mm, 2.50 mm"
    assert rows(tracking=facts) == [
        ("Followed points, median and mean error", "1.00 mm, 1.50 mm", still, False),
        ("Followed points after one scale, median and mean error", "0.90 mm, 1.40 mm", still, True),
        ("Followed points, median and mean error in the picture", "4.00 px, 4.25 px", "no motion 8.00 px, 8.25 px", True),
    ]  # fmt: skip


def test_scene_flow_rows_appear_only_with_ground_truth() -> None:
    what = "from frame to frame, median and mean error"
    picture = (f"Flow {what}", "4.000 px, 4.250 px", "no motion 8.000 px, 8.250 px", True)
    whole = Facts(model=track(1.0, 4.0), scaled=track(0.9, 3.0), still=track(2.0, 8.0))
    still = "no motion 2.000 mm, 2.500 mm"
    assert rows(flow=whole) == [
        picture,
        (f"Scene flow {what}", "1.000 mm, 1.500 mm", still, False),
        (f"Scene flow after one scale {what}", "0.900 mm, 1.400 mm", still, True),
    ]
    for each in (whole.model, whole.scaled, whole.still):
        each.median_mm = each.mean_mm = None
    assert rows(flow=whole) == [picture]


def test_trajectory_and_parts_rows_are_percentages() -> None:
    way = Facts(rigid_share=0.02, similarity_share=0.01, still_share=0.5)
    parts = Facts(motion=0.6, colour=0.3, size=0.05, explained=0.9)
    assert rows(trajectory=way, parts=parts) == [
        ("Trajectory (ATE), share of the path", "2.00 %", "no motion 50.00 %", False),
        ("Trajectory (ATE) after one scale, share of the path", "1.00 %", "no motion 50.00 %", True),
        ("Change of the pictures explained by motion", "60.00 %", "all parts together 90.00 %", True),
        ("Change of the pictures explained by colour", "30.00 %", "all parts together 90.00 %", True),
        ("Change of the pictures explained by size and opacity", "5.00 %", "all parts together 90.00 %", True),
    ]


@pytest.mark.parametrize(
    ("scale", "calibrated"), [(1.0, True), (1.04, True), (0.96, True), (1.06, False), (0.94, False), (8.0, False)]
)
def test_scale_sentence_says_uncalibrated_beyond_5_percent(scale: float, calibrated: bool) -> None:
    said = scale_sentence(geometry(depth=depth(scale)))
    assert said is not None and said.startswith(f"the factor from the model's lengths to true ones is {scale:g}"[:54])
    assert ("uncalibrated" in said) is not calibrated
    assert scale_sentence(geometry()) is None


def test_geometry_section_and_lines_contain_rows_and_scale() -> None:
    report: Any = Facts(
        geometry=geometry(depth=depth(2.0), normals=Facts(mean_deg=5, plane_mean_deg=12, level_mean_deg=None))
    )
    page = geometry_section(report)
    assert page.count("<tr><th scope") == 4 and page.count("absolute") == 1 and page.count("<td>relative") == 2
    assert "1,200 frames" in page and "true ones is 2: the model is uncalibrated" in page
    lines = geometry_lines(report)
    assert len(lines) == 4 and lines[-1].startswith("the factor from the model's lengths to true ones is 2:")
    assert lines[0].index("level") == lines[1].index("level") == lines[2].index("best-fit"), "columns are aligned"
    without: Any = Facts(geometry=geometry(normals=report.geometry.normals))
    assert "note" not in geometry_section(without) and len(geometry_lines(without)) == 1
