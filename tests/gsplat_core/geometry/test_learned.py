"""Depth by a user's network: what it says up to a factor and a summand becomes steady depth, and what cannot be right is doubted."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from onnx import TensorProto, helper, numpy_helper

from gsplat_core.depth import learned
from gsplat_core.depth.learned import AGAINST, FLAT, GIVEN, NOT_FINITE, UNLIKE, UNSEEN, LearnedDepth
from gsplat_core.depth.maps import DepthFinder, check_depth, new_estimator
from gsplat_core.errors import InvalidSetting
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import BELIEVED, DEPTH_ORIGINS, RELATIVE_DISTANCE, Frame
from tests.gsplat_core.endoscope.networks import conv, external_weights, write

HEIGHT, WIDTH = 96, 128
CAMERA = Camera.from_focal(100.0, WIDTH, HEIGHT)
POLL_NS = 300_000_000
RED = ([[1.0, 0.0, 0.0]], [0.0])
PLAIN = {"mean": [0, 0, 0], "std": [1, 1, 1]}


@pytest.fixture
def network(tmp_path):
    """Writes a network whose answer is the picture's red, from 0 to 1, or what `node` makes of it."""

    def make(name: str = "net.onnx", node=None, size=(HEIGHT, WIDTH), metadata=PLAIN, parts=()) -> Path:
        nodes, weights = conv(*RED, output="mask" if node is None else "red")
        return write(
            tmp_path / name,
            [*nodes, *([] if node is None else [node])],
            [*weights, *parts],
            size=size,
            metadata=metadata,
        )

    return make


def surface() -> np.ndarray:
    """Depth of a tilted wall with a bump, from 30 to 80."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return 55 + 20 * (x / WIDTH - 0.5) + 10 * (y / HEIGHT - 0.5) - 14 * np.exp(-((x - 60) ** 2 + (y - 40) ** 2) / 400)


def seen(values: np.ndarray, number: int = 0, **fields) -> Frame:
    """A frame whose red is `values`, from 0 to 1."""
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[..., 0] = np.rint(255 * values)
    return Frame(number, number * POLL_NS, image, **fields)


def inverse(depth: np.ndarray, factor: float = 20.0, summand: float = 0.0) -> np.ndarray:
    return factor / depth + summand


def off(found: np.ndarray, depth: np.ndarray) -> float:
    """Largest relative error after one factor."""
    ratio = found / depth
    return float(np.abs(ratio / np.median(ratio) - 1).max())


def test_learned_depth_scales_inverse_depth_to_relative_distance(network):
    found = LearnedDepth(str(network())).estimate(seen(inverse(surface())), CAMERA)
    assert found is not None and found.doubt is None and found.remark is None
    assert (found.origin, found.metric) == (DEPTH_ORIGINS["learned"], False)
    assert found.depth.shape == (HEIGHT, WIDTH) and (found.confidence == BELIEVED).all()
    assert off(found.depth, surface()) < 0.03
    assert np.exp(np.log(found.depth).mean()) == pytest.approx(RELATIVE_DISTANCE, rel=0.01)


@pytest.mark.parametrize("stated", ["address", "metadata"])
def test_learned_depth_values_option_depth(network, stated):
    if stated == "address":
        address = f"{network()}?values=depth"
    else:
        address = str(network(metadata={**PLAIN, "values": "depth"}))
    found = LearnedDepth(address).estimate(seen(surface() / 100), CAMERA)
    assert found is not None and off(found.depth, surface()) < 0.03


def test_learned_depth_address_overrides_model_metadata(network):
    address = f"{network(metadata={**PLAIN, 'values': 'depth'})}?values=inverse"
    found = LearnedDepth(address).estimate(seen(inverse(surface())), CAMERA)
    assert found is not None and off(found.depth, surface()) < 0.03


@pytest.mark.parametrize("size", [(HEIGHT, WIDTH), (48, 64), ("height", "width")])
@pytest.mark.parametrize("flat", [True, False])
def test_learned_depth_accepts_any_size_and_answer_shape(network, size, flat):
    axes = numpy_helper.from_array(np.array([1], np.int64), "axes")
    squeeze = helper.make_node("Squeeze", ["red", "axes"], ["mask"])
    path = network(node=squeeze, size=size, parts=[axes]) if flat else network(size=size)
    found = LearnedDepth(str(path)).estimate(seen(inverse(surface())), CAMERA)
    assert found is not None and off(found.depth, surface()) < 0.06


def test_learned_depth_default_normalisation(network):
    """(255 - 0.485 · 255) / (0.229 · 255) for white; a model may state otherwise."""
    finder = LearnedDepth(str(network(metadata=None)))
    answer = finder._network.run(np.full((8, 8, 3), 255, np.uint8))
    assert answer == pytest.approx((1 - 0.485) / 0.229, rel=1e-5)


def test_learned_depth_falls_back_to_multiples_of_32(network):
    """A network that halves its input four times and restores its size needs multiples of 16."""
    scales = numpy_helper.from_array(np.array([1, 1, 16, 16], np.float32), "scales")
    small = helper.make_node("AveragePool", ["red"], ["small"], kernel_shape=[16, 16], strides=[16, 16])
    large = helper.make_node("Resize", ["small", "", "scales"], ["large"], mode="nearest")
    both = helper.make_node("Add", ["red", "large"], ["mask"])
    nodes, weights = conv(*RED, output="red")
    path = network().with_name("unet.onnx")
    write(path, [*nodes, small, large, both], [*weights, scales], size=("h", "w"), metadata=PLAIN)
    assert LearnedDepth(str(path))._network.multiple_px == 32
    assert LearnedDepth(str(network(size=("h", "w"))))._network.multiple_px == 14


def test_learned_depth_is_steady_for_varying_factor_and_offset(network, rng):
    estimator, answers = LearnedDepth(str(network())), []
    for number in range(12):
        values = inverse(surface(), rng.uniform(8, 20), rng.uniform(0, 0.2)) + rng.normal(0, 0.004, (HEIGHT, WIDTH))
        answers.append(estimator.estimate(seen(np.clip(values, 0, 1), number), CAMERA).depth)
    for answer in answers[1:]:
        assert np.median(np.abs(answer / answers[0] - 1)) < 0.03
    assert np.median(answers[-1]) == pytest.approx(np.median(answers[0]), rel=0.02)


def test_learned_depth_reuses_answer_while_scope_is_still(network):
    estimator = LearnedDepth(str(network()))
    frame = seen(inverse(surface()))
    first = estimator.estimate(frame, CAMERA)
    moved = np.eye(4)
    moved[0, 3] = 1
    assert estimator.estimate(frame.with_fields(seq=1, pts_ns=POLL_NS // 3), CAMERA) is first
    assert estimator.estimate(frame.with_fields(seq=2, pts_ns=POLL_NS // 2), CAMERA.with_pose(moved)) is None
    assert estimator.estimate(frame.with_fields(seq=3, pts_ns=POLL_NS), CAMERA.with_pose(moved)) is not None


def test_learned_depth_takes_scale_from_recorded_depth(network):
    """Known in a few places, and wrong in some of them."""
    depth = np.zeros((HEIGHT, WIDTH), np.float32)
    depth[::3, ::4] = surface()[::3, ::4]
    depth[:20, :20] = 500
    frame = seen(inverse(surface(), 8, 0.3), depth=depth, depth_origin=DEPTH_ORIGINS["measured"])
    estimator = LearnedDepth(str(network()))
    found = estimator.estimate(frame, CAMERA)
    assert found is not None and np.median(np.abs(found.depth / surface() - 1)) < 0.02
    assert found.remark == GIVEN and not found.metric
    without = estimator.estimate(seen(inverse(surface(), 12, 0.1), 1), CAMERA)
    assert without is not None and without.remark is None
    assert np.median(np.abs(without.depth / surface() - 1)) < 0.02, "and goes on to say it"


def test_learned_depth_ignores_unconfident_recorded_depth(network):
    wrong = np.full((HEIGHT, WIDTH), 500, np.float32) + np.arange(WIDTH, dtype=np.float32)
    frame = seen(inverse(surface()), depth=wrong, depth_confidence=np.full_like(wrong, 0.4))
    found = LearnedDepth(str(network())).estimate(frame, CAMERA)
    assert (
        found is not None
        and found.remark is None
        and np.median(found.depth) == pytest.approx(RELATIVE_DISTANCE, rel=0.1)
    )


def test_learned_depth_resets_at_new_scene(network, rng):
    estimator = LearnedDepth(str(network()))
    estimator.estimate(seen(inverse(surface())), CAMERA)
    noise = cv2.GaussianBlur(rng.uniform(0, 1, (HEIGHT, WIDTH)), (0, 0), 4)
    other = 0.3 + 0.4 * (noise - noise.min()) / np.ptp(noise)
    fresh = LearnedDepth(str(network())).estimate(seen(other, 1), CAMERA)
    for fields in ({}, {"new_scene": "cut"}):
        found = estimator.estimate(seen(other, 1, **fields), CAMERA)
        assert np.array_equal(found.depth, fresh.depth)


@pytest.mark.parametrize(
    ("frame", "doubt"),
    [
        (seen(np.full((HEIGHT, WIDTH), 0.4)), FLAT),
        (seen(inverse(surface()), mask=np.zeros((HEIGHT, WIDTH), np.uint8)), UNSEEN),
        (seen(inverse(surface()), depth=(2500 / surface()).astype(np.float32)), AGAINST),
        (
            seen(
                inverse(surface()), depth=np.random.default_rng(1).uniform(40, 80, (HEIGHT, WIDTH)).astype(np.float32)
            ),
            UNLIKE,
        ),
    ],
)
def test_learned_depth_doubts_implausible_answers(network, frame, doubt):
    estimator = LearnedDepth(str(network()))
    found = estimator.estimate(frame, CAMERA)
    assert found is not None and found.doubt == doubt and not found.confidence.any()
    good = estimator.estimate(seen(inverse(surface()), 1), CAMERA)
    assert good is not None and good.doubt is None, "and the next one is not"


def test_learned_depth_doubts_non_finite_values(network):
    path = network(node=helper.make_node("Log", ["red"], ["mask"]))
    dark = inverse(surface())
    dark[:8] = 0
    found = LearnedDepth(str(path)).estimate(seen(dark), CAMERA)
    assert found is not None and found.doubt == NOT_FINITE


def test_learned_depth_is_deterministic(network):
    frames = [seen(inverse(surface(), 10 + number), number) for number in range(4)]
    one, other = (
        [estimator.estimate(frame, CAMERA) for frame in frames]
        for estimator in (LearnedDepth(str(network())) for _ in range(2))
    )
    assert [found.depth.tobytes() for found in one] == [found.depth.tobytes() for found in other]


def test_depth_network_is_cached_until_files_change(network):
    path = network()
    before = LearnedDepth(str(path))._network
    assert LearnedDepth(f"{path}?values=depth")._network is before
    path.with_name("net.onnx.json").write_text('{"values": "depth"}')
    assert LearnedDepth(str(path))._network.settings.values == "depth"


@pytest.mark.parametrize(
    ("operator", "options", "sentence"),
    [
        ("GlobalAveragePool", {}, "gives float32 [1, 1, 1, 1]"),
        ("Flatten", {}, "gives float32 [1, 12288]"),
        ("Shape", {}, "gives int64 [4]"),
    ],
)
def test_depth_network_with_wrong_output_shape_is_refused(network, operator, options, sentence):
    kind = TensorProto.INT64 if operator == "Shape" else TensorProto.FLOAT
    nodes, weights = conv(*RED, output="red")
    path = network().with_name("other.onnx")
    write(
        path,
        [*nodes, helper.make_node(operator, ["red"], ["mask"], **options)],
        weights,
        size=(HEIGHT, WIDTH),
        output_type=kind,
    )
    with pytest.raises(InvalidSetting) as caught:
        LearnedDepth(str(path))
    assert sentence in str(caught.value) and "it must give floats [1, h, w] or [1, 1, h, w]" in str(caught.value)


def test_depth_network_with_several_channels_is_refused(network):
    nodes, weights = conv([[1, 0, 0], [0, 1, 0]], [0, 0])
    path = write(network().with_name("two.onnx"), nodes, weights)
    with pytest.raises(InvalidSetting, match=r"gives float32 \[1, 2, 32, 40\]; it must give floats"):
        LearnedDepth(str(path))


def test_depth_network_file_checks(tmp_path):
    with pytest.raises(InvalidSetting, match=r"depth network .* keeps data in other files"):
        check_depth(f"onnx:{external_weights(tmp_path / 'net.onnx', 'weights.bin')}")
    with pytest.raises(InvalidSetting, match=r"depth network .*missing\.onnx cannot be read"):
        check_depth(f"onnx:{tmp_path / 'missing.onnx'}")


def test_depth_network_refuses_tool_network_settings(network):
    with pytest.raises(InvalidSetting, match="threshold: Extra inputs are not permitted"):
        LearnedDepth(str(network(metadata={"threshold": 0.4})))


@pytest.mark.parametrize(
    ("choice", "said"),
    [
        ("onnx", "depth is 'onnx'; it needs an address: onnx:FILE"),
        ("onnx:", "depth is 'onnx:'; it needs an address: onnx:FILE"),
        (
            "light:net.onnx",
            "depth is 'light:net.onnx'; choose auto, recorded, stereo, light, parallax, onnx:FILE, breathing, none",
        ),
        ("auto:net.onnx", "depth is 'auto:net.onnx'; choose auto"),
        ("onnx:net.onnx?values=metres", "has values 'metres'; choose inverse or depth"),
    ],
)
def test_check_depth_refuses_invalid_addresses(choice, said):
    with pytest.raises(InvalidSetting) as caught:
        check_depth(choice)
    assert said in str(caught.value)


def test_new_estimator_of_onnx_address_is_learned_depth(network):
    choice = f"onnx:{network('my:net?.onnx')}"
    check_depth(choice)
    assert isinstance(new_estimator(choice), LearnedDepth)
    frame = DepthFinder(choice, CAMERA).with_depth(seen(inverse(surface())))
    assert frame.depth_origin is DEPTH_ORIGINS["learned"] and (frame.depth > 0).all() and not frame.depth_is_metric


@pytest.mark.parametrize("size", [(30, 80), (80, 30), (64, 64), (500, 2)])
def test_on_grid_longer_side_is_grid_px(size):
    plane = learned._on_grid(np.ones((7, 9)), size)
    assert max(plane.shape) == learned.GRID_PX and plane.shape == pytest.approx(
        [max(1, side * learned.GRID_PX / max(size)) for side in size], abs=0.5
    )
