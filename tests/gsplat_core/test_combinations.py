"""Combinations of renderer, options, outputs and losses that are refused, each with one that works."""

from __future__ import annotations

import pytest

from gsplat_core.choices import (
    LOSSES,
    OF_EVERY_STEP,
    OPTIONS,
    OUTPUTS_OF,
    OWN_OPACITIES,
    RENDERERS,
    check_compared,
    check_losses,
    check_outputs,
    check_renderer_options,
)
from gsplat_core.errors import InvalidSetting
from gsplat_core.training.config import ReconstructorConfig


@pytest.mark.parametrize("name", OPTIONS)
def test_combination_tables_match_renderer_capabilities(name):
    capabilities = RENDERERS[name].capabilities
    assert {*OPTIONS[name]} == {*capabilities.options}
    assert {*OUTPUTS_OF[name]} == {*capabilities.outputs}


def test_combination_tables_contain_every_renderer():
    assert set(OPTIONS) == set(OUTPUTS_OF) == set(RENDERERS)


@pytest.mark.parametrize("renderer", OPTIONS)
@pytest.mark.parametrize("option", ["samples", "order", "progressive"])
def test_unsupported_renderer_option_error_names_alternative(renderer, option):
    if option in OPTIONS[renderer]:
        check_renderer_options(renderer, [option])
        return
    with pytest.raises(InvalidSetting, match=f"no option {option}; choose renderer stochastic"):
        check_renderer_options(renderer, [option])


@pytest.mark.parametrize("renderer", OUTPUTS_OF)
def test_unsupported_renderer_output_error_names_alternatives(renderer):
    check_outputs(renderer, OUTPUTS_OF[renderer])
    if renderer != "alpha":
        with pytest.raises(
            InvalidSetting, match="no output 'normals'; choose renderer alpha, or take the outputs image"
        ):
            check_outputs(renderer, ["depth", "normals"])


def test_external_renderer_not_checked_by_tables():
    check_renderer_options("another", ["samples"])
    check_outputs("another", ["heat"])


def test_loss_without_data_error_names_folder():
    check_compared(["semantics:0.5", "range"], ["labels", "ranges"], "case")
    check_compared(["flow"], [], "case")
    with pytest.raises(InvalidSetting, match="case has none; add labels/ to the recording"):
        check_compared(["flow", "semantics:0.5"], ["ranges"], "case")
    with pytest.raises(InvalidSetting, match="add scans/ to the recording, or leave range out"):
        check_compared(["range"], ["labels"], "case")


@pytest.mark.parametrize("loss", LOSSES)
def test_weighted_sum_renderers_accept_per_step_losses_only(loss):
    for renderer in RENDERERS:
        if renderer in OWN_OPACITIES and loss not in OF_EVERY_STEP:
            with pytest.raises(InvalidSetting, match="choose renderer alpha, or leave the losses"):
                check_losses(renderer, [f"{loss}:0.5"])
            with pytest.raises(InvalidSetting, match="choose renderer alpha"):
                ReconstructorConfig(renderer=renderer, losses=(loss,))
        else:
            check_losses(renderer, [loss])
