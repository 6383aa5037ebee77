"""Strategies in gsplat's calling convention: relocation against the published sum, rows of parameters and optimisers, schedules."""

import inspect
from decimal import Decimal, getcontext
from math import comb

import pytest
import torch

import gsplat_core
from gsplat_core import DefaultStrategy, MCMCStrategy, Strategy, rasterization
from gsplat_core.errors import InvalidInput
from gsplat_core.training.strategies import strategy as ops
from gsplat_core.training.strategies.strategy import MOST_COPIES, binomials, compute_relocation

COUNT = 40


def scene(count=COUNT, seed=0, frozen=True):
    random = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.randn(*shape, generator=random)
    values = {
        "means": draw(count, 3) + torch.tensor([0.0, 0.0, 4.0]), "scales": 0.3 * draw(count, 3) - 2.5,
        "quats": draw(count, 4), "opacities": draw(count), "colors": draw(count, 3).sigmoid(),
    }  # fmt: skip
    params = torch.nn.ParameterDict(values)
    if frozen:
        params["label"] = torch.nn.Parameter(torch.arange(count), requires_grad=False)
    optimizers = {name: torch.optim.Adam([p], lr=1e-3) for name, p in params.items() if p.requires_grad}
    for name, optimizer in optimizers.items():
        params[name].grad = draw(*params[name].shape)
        optimizer.step()
    return params, optimizers


def moments(params, optimizers, name):
    (parameter,) = optimizers[name].param_groups[0]["params"]
    assert parameter is params[name] and set(optimizers[name].state) == {parameter}
    return optimizers[name].state[parameter]["exp_avg"]


def picture(params, **options):
    width, height = 48, 32
    return rasterization(
        params["means"], params["quats"], params["scales"].exp(), params["opacities"].sigmoid(), params["colors"],
        torch.eye(4).expand(2, 4, 4), torch.tensor([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]]).expand(2, 3, 3), width, height,
        **{"packed": False} | options,
    )  # fmt: skip


@pytest.mark.parametrize("opacity", [0.005, 0.3, 0.9, 0.9999])
def test_compute_relocation_equals_published_sum(opacity):
    getcontext().prec = 60
    counts = [1, 2, 3, 7, 20, 51]
    o = torch.full((len(counts),), opacity, dtype=torch.float64)
    scales = torch.rand(len(counts), 3, dtype=torch.float64) + 0.1
    found, sized = compute_relocation(o, scales, torch.tensor(counts), binomials())
    for row, n in enumerate(counts):
        after = 1 - (1 - Decimal(opacity)) ** (1 / Decimal(n))
        total = sum(
            comb(i - 1, k) * (-1) ** k * after ** (k + 1) / Decimal(k + 1).sqrt()
            for i in range(1, n + 1) for k in range(i)
        )  # fmt: skip
        assert found[row].item() == pytest.approx(float(after), rel=1e-12)
        assert (sized[row] / scales[row]).tolist() == pytest.approx([float(Decimal(opacity) / total)] * 3, rel=1e-9)


def test_compute_relocation_clamps_ratios_and_keeps_shape():
    o, s = torch.tensor([[0.5], [0.5], [0.0]]), torch.ones(3, 3)
    found, sized = compute_relocation(o, s, torch.tensor([0, 1000, 4]), binomials())
    expected, _ = compute_relocation(o[:2, 0], s[:2], torch.tensor([1, MOST_COPIES]), binomials())
    assert torch.equal(found[:2, 0], expected) and found.shape == (3, 1)
    assert found[2] == 0 and torch.equal(sized[2], s[2])
    with pytest.raises(InvalidInput, match=r"ratios \[N\]"):
        compute_relocation(o, s, torch.ones(2), binomials())


def test_sample_add_copies_keep_picture():
    params, optimizers = scene(1, frozen=False)
    with torch.no_grad():
        params["means"].copy_(torch.tensor([[0.0, 0, 4]]))
        params["scales"].fill_(-0.5)
        params["opacities"].fill_(0.5)
    before = picture(params)[1]
    ops.sample_add(params, optimizers, {}, 2, binomials())
    after = picture(params)[1]
    assert len(params["means"]) == 3
    assert (after - before).abs().max() < 0.1 * before.max()


def test_duplicate_split_and_remove_keep_moments_and_statistics_aligned():
    params, optimizers = scene()
    state = {"count": torch.arange(float(COUNT)), "scene_scale": 1.0}
    mask = torch.zeros(COUNT, dtype=torch.bool)
    mask[[3, 8]] = True
    first = {name: (p.detach().clone(), None if name == "label" else moments(params, optimizers, name).clone())
             for name, p in params.items()}  # fmt: skip
    ops.duplicate(params, optimizers, state, mask)
    for name, (values, averages) in first.items():
        assert torch.equal(params[name], torch.cat([values, values[mask]]))
        if averages is not None:
            assert torch.equal(moments(params, optimizers, name), torch.cat([averages, 0 * averages[mask]]))
    assert state["count"][-2:].tolist() == [3, 8]
    ops.remove(params, optimizers, state, torch.cat([mask, torch.zeros(2, dtype=torch.bool)]))
    assert params["label"].tolist() == [*(each for each in range(COUNT) if each not in (3, 8)), 3, 8]
    rest = mask.nonzero()[:, 0]
    ops.split(params, optimizers, state, params["label"] == 8, revised_opacity=True)
    assert params["label"][-2:].tolist() == [8, 8] and state["count"][-2:].tolist() == [8, 8]
    torch.testing.assert_close(params["scales"][-1].exp() * ops.SHRINK, first["scales"][0][rest[1]].exp())
    kept = 1 - (1 - params["opacities"][-2:].sigmoid()).prod()
    torch.testing.assert_close(kept, first["opacities"][0][rest[1]].sigmoid())
    assert not moments(params, optimizers, "means")[-2:].any()
    for name, optimizer in optimizers.items():
        params[name].grad = torch.ones_like(params[name])
        optimizer.step()
    assert all(p.isfinite().all() for p in params.values())


def test_split_samples_have_covariance_of_gaussian():
    params, optimizers = scene(1, frozen=False)
    with torch.no_grad():
        params["quats"].copy_(torch.tensor([[0.9, 0.3, -0.2, 0.1]]))
        params["scales"].copy_(torch.tensor([[0.0, -1.0, -2.0]]))
    for name in list(params):
        params[name] = torch.nn.Parameter(params[name].detach().expand(20_000, *params[name].shape[1:]).clone())
    optimizers = {name: torch.optim.SGD([p], lr=1e-3) for name, p in params.items()}
    expected = gsplat_core.quat_scale_to_covar_preci(params["quats"][:1], params["scales"][:1].exp())[0][0]
    generator = torch.Generator().manual_seed(1)
    ops.split(params, optimizers, {}, torch.ones(20_000, dtype=torch.bool), generator=generator)
    torch.testing.assert_close(params["means"].detach().T.cov(), expected.detach(), atol=0.02, rtol=0)


def test_reset_opa_limits_opacities_and_clears_moments():
    params, optimizers = scene()
    before = params["opacities"].detach().sigmoid()
    ops.reset_opa(params, optimizers, {}, 0.4)
    torch.testing.assert_close(params["opacities"].detach().sigmoid(), before.clamp(max=0.4))
    assert not moments(params, optimizers, "opacities").any() and moments(params, optimizers, "means").any()


def test_relocate_moves_dead_gaussians_and_shares_opacity():
    params, optimizers = scene()
    with torch.no_grad():
        params["opacities"][:] = -8.0
        params["opacities"][5] = 1.0
    dead = params["opacities"].detach().sigmoid() <= 0.005
    ops.relocate(params, optimizers, {}, dead, binomials())
    assert (params["label"] == 5).all() and (params["means"] == params["means"][5]).all()
    assert not moments(params, optimizers, "scales")[5].any()
    together = 1 - (1 - params["opacities"].detach().sigmoid().double()).prod()
    assert together.item() == pytest.approx(torch.tensor(1.0).sigmoid().item(), rel=1e-5)


def test_inject_noise_follows_covariance_and_spares_opaque_gaussians():
    params, optimizers = scene(2, frozen=False)
    with torch.no_grad():
        params["opacities"][:] = torch.tensor([-9.0, 3.0])
        params["scales"][:, 0] += 4
    before, axes = params["means"].detach().clone(), ops.rotations(params["quats"].detach())
    ops.inject_noise_to_position(params, optimizers, {}, 1.0)
    moved = params["means"].detach() - before
    along = (moved[0] @ axes[0]).abs()
    assert along[0] > 50 * along[1:].max() and not moved[1].abs().max() > 1e-6


@pytest.mark.parametrize("absgrad", [False, True])
def test_adc_grows_by_screen_gradients(absgrad):
    params, optimizers = scene()
    strategy = DefaultStrategy(absgrad=absgrad, refine_start_iter=0, refine_every=2, prune_opa=0.0, grow_scale3d=0.08)
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state(scene_scale=1.0)
    expected, seen = torch.zeros(COUNT), torch.zeros(COUNT)
    for step in (1, 2):
        colors, _, info = picture(params, absgrad=absgrad)
        strategy.step_pre_backward(params, optimizers, state, step, info)
        colors[..., :16, :].square().mean().backward()
        gradient = info["means2d"].absgrad if absgrad else info["means2d"].grad
        visible = (info["radii"] > 0).all(-1)
        expected += ((gradient * torch.tensor([48.0, 32.0])).norm(dim=-1) * visible).sum(0)
        seen += visible.sum(0)
        if step == 1:
            strategy.step_post_backward(params, optimizers, state, step, info)
            torch.testing.assert_close(state["grad2d"], expected)
            assert torch.equal(state["count"], seen)
    strategy.grow_grad2d = (expected / seen.clamp(min=1)).median().item()
    steep = expected / seen.clamp(min=1) > strategy.grow_grad2d
    large = params["scales"].detach().exp().amax(-1) > 0.08
    assert (steep & large).any() and (steep & ~large).any()
    strategy.step_post_backward(params, optimizers, state, 2, info)
    labels = params["label"].bincount(minlength=COUNT)
    assert torch.equal(labels, 1 + steep.long()) and not state["grad2d"].any() and len(state["count"]) == labels.sum()
    shrunk = params["label"][-2 * int((steep & large).sum()) :]
    assert set(shrunk.tolist()) == set((steep & large).nonzero()[:, 0].tolist())


def test_adc_counts_packed_splats_as_dense_ones():
    states = []
    for packed in (False, True):
        params, optimizers = scene()
        strategy = DefaultStrategy(refine_scale2d_stop_iter=10)
        state = strategy.initialize_state()
        colors, _, info = picture(params)
        strategy.step_pre_backward(params, optimizers, state, 1, info)
        colors.square().mean().backward()
        if packed:
            cameras, rows = (info["radii"] > 0).all(-1).nonzero(as_tuple=True)
            centres = info["means2d"][cameras, rows].detach()
            centres.grad = info["means2d"].grad[cameras, rows]
            info = {**info, "means2d": centres, "gaussian_ids": rows, "radii": info["radii"][cameras, rows]}
        strategy.step_post_backward(params, optimizers, state, 1, info, packed=packed)
        states.append(state)
    for name in ("grad2d", "count", "radii"):
        torch.testing.assert_close(states[0][name], states[1][name])


@pytest.mark.parametrize("stated", [False, True])
@pytest.mark.parametrize("rendered", [{"packed": True}, {"packed": False}, {"packed": True, "with_ut": True}])
def test_adc_detects_packed_rows_from_render_info(stated, rendered):
    params, optimizers = scene()
    strategy = DefaultStrategy(refine_scale2d_stop_iter=10)
    state = strategy.initialize_state()
    colors, _, info = picture(params, **rendered)
    strategy.step_pre_backward(params, optimizers, state, 1, info)
    colors.square().mean().backward()
    strategy.step_post_backward(params, optimizers, state, 1, info, packed=stated)
    _, _, dense = picture(params, with_ut="with_ut" in rendered)
    assert torch.equal(state["count"], (dense["radii"] > 0).all(-1).sum(0).float())
    assert state["grad2d"].any() and not state["grad2d"][state["count"] == 0].any()


def test_adc_error_states_reason_of_missing_gradient():
    params, optimizers = scene()

    def train(strategy, **options):
        colors, _, info = picture(params, **options)
        state = strategy.initialize_state()
        strategy.step_pre_backward(params, optimizers, state, 1, info)
        colors.square().mean().backward()
        strategy.step_post_backward(params, optimizers, state, 1, info)

    with pytest.raises(AssertionError, match="means2d has no absolute gradient; render with absgrad=True"):
        train(DefaultStrategy(absgrad=True))
    with pytest.raises(AssertionError, match="with_eval3d=True have none: use MCMCStrategy"):
        train(DefaultStrategy(), with_ut=True, with_eval3d=True)
    with torch.no_grad():
        _, _, info = picture(params)
    with pytest.raises(AssertionError, match="rendered without gradients"):
        DefaultStrategy().step_pre_backward(params, optimizers, {}, 1, info)


@pytest.mark.parametrize(("compat", "expected"), [("1.6", [4, 8]), ("1.5.3", [])])
def test_adc_resets_opacities_except_as_1_5_3(compat, expected):
    params, optimizers = scene()
    strategy = DefaultStrategy(reset_every=4, refine_stop_iter=11, compat=compat)
    state, resets = strategy.initialize_state(), []
    colors, _, info = picture(params)
    strategy.step_pre_backward(params, optimizers, state, 0, info)
    colors.sum().backward()
    for step in range(14):
        with torch.no_grad():
            params["opacities"][:] = 1.0
        strategy.step_post_backward(params, optimizers, state, step, info)
        if params["opacities"].max() < 0:
            resets.append(step)
    assert resets == expected


class OneByOne(DefaultStrategy):
    """Refinement by the row operations, one after the other."""

    def _grow_gs(self, params, optimizers, state, step):
        copied, divided = self._to_grow(params, state, step)
        ops.duplicate(params, optimizers, state, copied)
        longer = torch.cat([divided, divided.new_zeros(int(copied.sum()))])
        ops.split(params, optimizers, state, longer, self.revised_opacity, generator=self.generator)
        return int(copied.sum()), int(divided.sum())


def refined(strategy, optimizer=lambda p: torch.optim.Adam([p]), column=False, step=40):
    """Refine a scene, and return its parameters, optimisers' states and statistics by name."""
    params, _ = scene(300)
    if column:
        params["opacities"] = torch.nn.Parameter(params["opacities"].detach()[:, None])
    optimizers = {name: optimizer(p) for name, p in params.items() if p.requires_grad}
    random = torch.Generator().manual_seed(1)
    for name, each in optimizers.items():
        params[name].grad = torch.randn(params[name].shape, generator=random)
        each.step()
    state = strategy.initialize_state()
    state |= {name: torch.rand(300, generator=random) for name in ("grad2d", "count", "radii", "further")}
    centres = torch.zeros(1, 300, 2, requires_grad=True)
    centres.grad = torch.zeros(1, 300, 2)
    info = {"means2d": centres, "radii": torch.zeros(1, 300, 2), "width": 48, "height": 32, "n_cameras": 1}
    strategy.generator = torch.Generator().manual_seed(5)
    strategy.step_post_backward(params, optimizers, state, step, info)
    values = {name: p.detach() for name, p in params.items()} | {f"state {name}": v for name, v in state.items()}
    for name, each in optimizers.items():
        assert each.param_groups[0]["params"][0] is params[name] and set(each.state) <= {params[name]}
        values |= {f"{name} {key}": value for key, value in each.state.get(params[name], {}).items()}
    return values


@pytest.mark.parametrize(
    "optimizer",
    [
        lambda p: torch.optim.Adam([p]),
        lambda p: torch.optim.SGD([p], lr=0.1),
        lambda p: torch.optim.NAdam([p]),
    ],
    ids=["adam", "sgd", "nadam"],
)
@pytest.mark.parametrize(
    "options",
    [
        {},
        {
            "revised_opacity": True,
            "refine_scale2d_stop_iter": 100,
            "grow_scale2d": 0.5,
            "prune_scale2d": 0.9,
            "reset_every": 30,
            "prune_scale3d": 0.5,
        },
        {"reset_every": 30, "compat": "1.5.3", "prune_scale3d": 0.15},
        {"grow_grad2d": 1e9, "prune_opa": 0.0},
        {"grow_grad2d": -1.0, "prune_opa": 1.1},
    ],
    ids=["plain", "radii", "oversized", "nothing", "everything"],
)
@pytest.mark.parametrize("column", [False, True])
def test_adc_refines_in_one_pass_as_its_row_operations_do(optimizer, options, column, capsys):
    options = {
        "refine_start_iter": 1, "refine_every": 20, "reset_every": 60, "grow_grad2d": 0.6, "grow_scale3d": 0.1,
        "prune_opa": 0.4, "verbose": True,
    } | options  # fmt: skip
    expected = refined(OneByOne(**options), optimizer, column)
    report = capsys.readouterr().out
    found = refined(DefaultStrategy(**options), optimizer, column)
    assert capsys.readouterr().out == report != ""
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        assert torch.equal(found[name], value) if isinstance(value, torch.Tensor) else found[name] == value


def test_adc_replaces_tensors_once_unless_subclass_overrides_part(monkeypatch):
    replaced, calls = [], []
    own = ops.update_rows
    monkeypatch.setattr(ops, "update_rows", lambda *args: (replaced.append(1), own(*args)))
    options = {"refine_start_iter": 1, "refine_every": 20, "grow_grad2d": 0.6, "grow_scale3d": 0.1, "prune_opa": 0.4}
    refined(DefaultStrategy(**options))
    assert len(replaced) == 1
    refined(OneByOne(**options))
    assert len(replaced) == 1 + 3

    class Keeping(DefaultStrategy):
        def _prune_gs(self, params, optimizers, state, step):
            calls.append(step)
            return 0

    assert len(refined(Keeping(**options))["means"]) > 300 and calls == [40]
    strategy = DefaultStrategy(**options)
    strategy._grow_gs = lambda params, optimizers, state, step: (calls.append(step), 0)
    assert len(refined(strategy)["means"]) < 300 and calls == [40, 40]


def test_adc_prunes_transparent_and_oversized_gaussians():
    params, optimizers = scene()
    with torch.no_grad():
        params["opacities"][:] = 0.0
        params["opacities"][4] = -7.0
        params["scales"][9] = 1.0
    strategy = DefaultStrategy(refine_start_iter=1, refine_every=1, reset_every=3, grow_grad2d=1e9, prune_scale3d=0.5)
    state = strategy.initialize_state()
    for step in (2, 4):
        colors, _, info = picture(params)
        strategy.step_pre_backward(params, optimizers, state, step, info)
        colors.sum().backward()
        strategy.step_post_backward(params, optimizers, state, step, info)
        gone = set(range(COUNT)) - set(params["label"].tolist())
        assert gone == ({4} if step == 2 else {4, 9})


def test_mcmc_grows_to_cap_and_is_deterministic():
    ends = []
    for _ in range(2):
        params, optimizers = scene()
        random = torch.Generator().manual_seed(3)
        strategy = MCMCStrategy(cap_max=43, refine_start_iter=0, refine_every=2, generator=random)
        state, counts = strategy.initialize_state(), []
        for step in range(7):
            strategy.step_post_backward(params, optimizers, state, step, {}, lr=1e-3)
            counts.append(len(params["means"]))
        assert counts == [40, 40, 42, 42, 43, 43, 43]
        assert all(len(p) == 43 for p in params.values()) and moments(params, optimizers, "quats").shape == (43, 4)
        ends.append(params)
    assert all(torch.equal(ends[0][name], ends[1][name]) for name in ends[0])


def test_mcmc_refuses_a_scene_without_live_gaussians():
    params, optimizers = scene()
    with torch.no_grad():
        params["opacities"][:] = -9.0
    strategy = MCMCStrategy(refine_start_iter=0, refine_every=1)
    with pytest.raises(RuntimeError, match=r"no live Gaussians.*min_opacity=0\.005"):
        strategy.step_post_backward(params, optimizers, strategy.initialize_state(), 1, {}, lr=1e-3)


def test_mcmc_relocates_gaussian_with_nan_opacity():
    params, optimizers = scene()
    with torch.no_grad():
        params["opacities"][3] = float("nan")
    moments = [
        state[name]
        for each in optimizers.values()
        for state in each.state.values()
        for name in ("exp_avg", "exp_avg_sq")
    ]
    assert moments
    for values in moments:
        values[3] = float("nan")
    strategy = MCMCStrategy(refine_start_iter=0, refine_every=1, cap_max=COUNT + 1)
    strategy.step_post_backward(params, optimizers, strategy.initialize_state(), 1, {}, lr=0.0)
    assert len(params["means"]) == COUNT + 1 and params["opacities"].isfinite().all()
    assert 3 not in params["label"]
    for each in optimizers.values():
        for state in each.state.values():
            assert state["exp_avg"].isfinite().all() and state["exp_avg_sq"].isfinite().all()


def test_relocation_of_no_gaussian_changes_nothing_and_of_all_is_refused():
    params, optimizers = scene()
    before = {name: tensor.detach().clone() for name, tensor in params.items()}
    ops.relocate(params, optimizers, {}, torch.zeros(COUNT, dtype=torch.bool), binomials())
    ops.sample_add(params, optimizers, {}, 0, binomials())
    with pytest.raises(InvalidInput, match=f"selects all {COUNT} Gaussians"):
        ops.relocate(params, optimizers, {}, torch.ones(COUNT, dtype=torch.bool), binomials())
    assert all(torch.equal(params[name], before[name]) for name in before)


@pytest.mark.parametrize(
    "mask", [torch.ones(COUNT, dtype=torch.uint8), torch.tensor([1, 2, 3]), torch.zeros(COUNT - 1, dtype=torch.bool)]
)
@pytest.mark.parametrize("operation", [ops.duplicate, ops.split, ops.remove, ops.relocate])
def test_strategy_operations_refuse_invalid_mask(operation, mask):
    params, optimizers = scene()
    before = {name: tensor.detach().clone() for name, tensor in params.items()}
    further = (binomials(),) if operation is ops.relocate else ()
    with pytest.raises(InvalidInput, match=rf"mask must be bool \[N\] with N = {COUNT} Gaussians, got {mask.dtype}"):
        operation(params, optimizers, {}, mask, *further)
    assert all(torch.equal(params[name], before[name]) for name in before)


def test_duplicate_keeps_state_values_without_rows():
    params, _ = scene(frozen=False)
    optimizers = {name: torch.optim.NAdam([p], lr=1e-3) for name, p in params.items()}
    for name, optimizer in optimizers.items():
        params[name].grad = torch.ones_like(params[name])
        optimizer.step()
    state = {"scene_scale": torch.tensor(2.0), "age": torch.arange(COUNT)}
    ops.duplicate(params, optimizers, state, torch.arange(COUNT) < 5)
    assert state["scene_scale"] == 2 and state["age"].tolist() == [*range(COUNT), *range(5)]
    kept = optimizers["means"].state[params["means"]]
    assert kept["mu_product"].dim() == 0 and len(kept["exp_avg"]) == COUNT + 5


def test_strategies_refuse_inconsistent_parameters():
    params, optimizers = scene()
    with pytest.raises(AssertionError, match="one optimizer of the same name"):
        Strategy().check_sanity(params, {name: o for name, o in optimizers.items() if name != "quats"})
    with pytest.raises(AssertionError, match="2 parameter groups"):
        optimizers["means"].add_param_group({"params": [torch.nn.Parameter(torch.zeros(1))]})
        MCMCStrategy().check_sanity(params, optimizers)
    params, optimizers = scene()
    del params["quats"], optimizers["quats"]
    with pytest.raises(AssertionError, match="lacks quats"):
        DefaultStrategy().check_sanity(params, optimizers)
    with pytest.raises(AssertionError, match="info lacks 'means2d'"):
        DefaultStrategy().step_pre_backward(params, optimizers, {}, 0, {})


def test_strategy_positional_parameters_equal_gsplat():
    positional = lambda kind: [
        f"{p.name}={p.default}" for p in inspect.signature(kind).parameters.values() if p.kind is not p.KEYWORD_ONLY
    ]
    assert positional(DefaultStrategy) == [
        "prune_opa=0.005", "grow_grad2d=0.0002", "grow_scale3d=0.01", "grow_scale2d=0.05", "prune_scale3d=0.1",
        "prune_scale2d=0.15", "refine_scale2d_stop_iter=0", "refine_start_iter=500", "refine_stop_iter=15000",
        "reset_every=3000", "refine_every=100", "pause_refine_after_reset=0", "absgrad=False", "revised_opacity=False",
        "verbose=False", "key_for_gradient=means2d",
    ]  # fmt: skip
    assert positional(MCMCStrategy) == [
        "cap_max=1000000", "noise_lr=500000.0", "refine_start_iter=500", "refine_stop_iter=25000", "refine_every=100",
        "min_opacity=0.005", "verbose=False",
    ]  # fmt: skip
