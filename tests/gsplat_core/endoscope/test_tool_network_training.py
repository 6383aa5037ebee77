"""Drawn training pictures have exact masks, and OpenCV computes what the trained network computes."""

from __future__ import annotations

import cv2
import numpy as np
import torch

from benchmarks.tool_network.bodies import Canvas
from benchmarks.tool_network.flexible import accessory, hollow_organ, narrow_band
from benchmarks.tool_network.network import INPUTS, ToolNetwork, features
from benchmarks.tool_network.tissue import dark, glare, pale
from benchmarks.tool_network.train import INPUT_PX, Store, altered, export, from_files, reduced
from gsplat_core.endoscope import tools


def test_accessory_changes_image_only_under_mask():
    covered = 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        organ = hollow_organ(rng, 96, 120)
        canvas = Canvas(organ.copy(), np.zeros((96, 120), np.float32), organ.reshape(-1, 3).mean(0), 0.8)
        accessory(rng, canvas)
        assert organ.shape == (96, 120, 3) and np.isfinite(canvas.image).all()
        np.testing.assert_array_equal(canvas.image[canvas.mask == 0], organ[canvas.mask == 0])
        covered += bool((canvas.mask > 0.5).mean() > 0.005)
    assert covered >= 6


def test_narrow_band_removes_red():
    picture = np.zeros((4, 4, 3), np.float32)
    picture[..., 0] = 1
    assert not narrow_band(np.random.default_rng(0), picture).any()


def test_store_replaces_oldest_images():
    store = Store(3, torch.device("cpu"))
    pictures = np.stack([np.full((128, 160, 4), value, np.uint8) for value in range(1, 5)])
    store.add(pictures[:2])
    store.add(pictures[2:])
    assert store.pictures[:, 0, 0, 0].tolist() == [4, 2, 3]


def test_altered_transforms_masks_with_images():
    """A picture that is bright exactly at the tool stays bright at the transformed tool mask."""
    plain = torch.zeros((8, *INPUT_PX, 4))
    plain[:, 20:60, 30:80] = 1
    pictures, cover = altered(plain.permute(0, 3, 1, 2), torch.Generator().manual_seed(0))
    bright = torch.nn.functional.avg_pool2d(pictures.mean(1, keepdim=True), 2)
    assert bright[cover > 0.99].min() > 0.4
    assert bright[cover == 0].max() < 0.4


def test_product_features_equal_training_features():
    """The picture has a black surround, which is excluded from the means."""
    picture = np.random.default_rng(0).integers(0, 256, (*INPUT_PX, 3)).astype(np.uint8)
    picture[:, :40] = 3
    planes = torch.from_numpy(picture.transpose(2, 0, 1)[None].astype(np.float32) / 255)
    np.testing.assert_allclose(tools.features(picture, INPUTS), features(planes).numpy(), atol=1e-5)


def test_exported_network_in_opencv_equals_torch(tmp_path):
    torch.manual_seed(0)
    network = ToolNetwork().eval()
    picture = torch.randint(0, 256, (1, 128, 160, 4), dtype=torch.uint8)
    planes = features(reduced(picture)[:, :3])
    export(network, tmp_path / "network.onnx")
    loaded = cv2.dnn.readNetFromONNX(str(tmp_path / "network.onnx"))
    loaded.setInput(planes.numpy())
    with torch.no_grad():
        wanted = network(planes).numpy()
    assert wanted.shape == (1, 1, INPUT_PX[0] // 2, INPUT_PX[1] // 2)
    np.testing.assert_allclose(loaded.forward(), wanted, atol=1e-3 * float(np.abs(wanted).max()))


def test_from_files_reads_each_finished_file_once(tmp_path):
    pictures = np.full((2, 128, 160, 4), 7, np.uint8)
    for name in ("training_000_000000", "validation_000_000000", "training_001_000003.part"):
        np.save(tmp_path / f"{name}.npy", pictures)
    read: set[str] = set()
    first = list(from_files(tmp_path, read))
    assert [validates for validates, _ in first] == [False, True]
    np.testing.assert_array_equal(first[0][1], pictures)
    assert not list(from_files(tmp_path, read))
    np.save(tmp_path / "training_001_000003.npy", pictures)
    assert [validates for validates, _ in from_files(tmp_path, read)] == [False]


def test_pale_dark_and_glare_change_colour_in_expected_direction():
    """Pale tissue has less colour than before, black regions are darker, and highlights are brighter."""
    red = np.broadcast_to(np.float32([0.6, 0.15, 0.1]), (96, 120, 3)).copy()
    for seed in range(6):
        rng = np.random.default_rng(seed)
        assert np.ptp(pale(rng, red).mean((0, 1))) < np.ptp(red[0, 0])
        assert dark(rng, red).min() < 0.5 * red.max() and (dark(rng, red) <= red + 0.1).all()
        assert (glare(rng, red) >= red - 1e-6).all()
