"""Section of `report.html` on content hidden from the camera: tissue behind tools, depth, side
view."""

from __future__ import annotations

from services.reports.pictures import HiddenPictures
from services.reports.schema import DepthErrors, RunReport, TruthFacts


def hidden_section(report: RunReport, pictures: HiddenPictures | None) -> str:
    """Return pictures of the last frame, and scores if the recording has ground truth."""
    truth = report.quality.truth
    if pictures is None and truth is None:
        return ""
    return (
        "<section><h2>What the camera does not show</h2>"
        f"{'' if pictures is None else _row(pictures)}{'' if truth is None else _figures(truth)}</section>"
    )


def _row(pictures: HiddenPictures) -> str:
    names = ("Raw", "Tissue behind the tool", "Depth", "From the side")
    uris = (pictures.raw, pictures.behind, pictures.depth, pictures.aside)
    heads = "".join(f'<div class="head">{name}</div>' for name in names)
    images = "".join(
        f'<img src="{uri}" alt="frame {pictures.seq}, {name.lower()}">' for name, uri in zip(names, uris, strict=True)
    )
    return (
        f'<p class="lead">Frame {pictures.seq} at {pictures.time_s:.2f} s. Tissue behind tools and outside of the view is shown as it was seen last;'
        " where the model has nothing it is grey. From the side: the same moment, 16 degrees aside.</p>"
        f'<div class="frames">{heads}{images}</div>'
    )


def _figures(truth: TruthFacts) -> str:
    tables = ""
    if truth.behind_tools_psnr_db is not None:
        tables += _table(
            f"Behind tools, PSNR of {truth.frames} frames",
            ("IntraSplat", _decibels(truth.behind_tools_psnr_db)),
            ("Each pixel as it was seen last", _decibels(truth.last_seen_psnr_db)),
            ("Filled in from around the tool", _decibels(truth.inpainted_psnr_db)),
        )
    for name, errors in (("Depth that is seen", truth.depth), ("Depth behind tools", truth.depth_behind_tools)):
        tables += "" if errors is None else _depth(name, errors)
    return (
        '<p class="lead">Against the truth of a synthetic recording, which training never sees. The planes know the truth.</p>'
        f'<div class="three">{tables}</div>'
    )


def _depth(name: str, errors: DepthErrors) -> str:
    return _table(
        f"{name}, RMS error of {errors.frames} frames",
        ("IntraSplat", _percent(errors.reconstruction)),
        ("Best level plane", _percent(errors.level_plane)),
        ("Best tilted plane", _percent(errors.best_plane)),
    )


def _table(name: str, own: tuple[str, str], *baselines: tuple[str, str]) -> str:
    """Return a table of the reconstruction's score and its baselines."""
    rows = "".join(
        f'<tr{" class=ours" if row is own else ""}><th scope="row">{row[0]}</th><td class="n">{row[1]}</td></tr>'
        for row in (own, *baselines)
    )
    return f'<table><thead><tr><th scope="col" colspan="2">{name}</th></tr></thead><tbody>{rows}</tbody></table>'


def _decibels(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f} dB"


def _percent(share: float) -> str:
    return f"{100 * share:.2f} %"
