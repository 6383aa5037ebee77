"""Splats as PNG pictures, and as bytes of files."""

from __future__ import annotations

import json
import logging

import numpy as np
import pytest
import torch

from gsplat_core import InvalidInput, PngCompression, export_splats, load_ply
from gsplat_core.errors import BundleCorrupt
from gsplat_core.io import png_compression


def splats(count: int = 25, bases: int = 4) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(2)
    random = lambda *shape: torch.randn(count, *shape, generator=generator)
    return {
        "means": 5 * random(3), "scales": random(3) - 3, "quats": torch.nn.functional.normalize(random(4), dim=-1),
        "opacities": random(), "sh0": random(1, 3), "shN": 0.1 * random(bases - 1, 3), "features": random(2),
    }  # fmt: skip


def ordered(values: dict[str, torch.Tensor], like: torch.Tensor) -> dict[str, torch.Tensor]:
    """Rows in the order of the features, which are stored without loss."""
    index = {tuple(row.tolist()): i for i, row in enumerate(values["features"])}
    return {name: tensor[[index[tuple(row.tolist())] for row in like]] for name, tensor in values.items()}


@pytest.mark.parametrize("use_sort", [False, True])
@pytest.mark.parametrize("bases", [1, 4])
def test_png_compression_round_trip_errs_at_most_half_a_step(tmp_path, use_sort: bool, bases: int):
    given = splats(bases=bases)
    before = {name: tensor.clone() for name, tensor in given.items()}
    codec = PngCompression(use_sort=use_sort)
    codec.compress(str(tmp_path), given)
    assert all(torch.equal(given[name], before[name]) for name in before)
    found = codec.decompress(str(tmp_path))
    expected = ordered(given, found["features"])
    if not use_sort:
        assert torch.equal(found["features"], given["features"])
    for name, tensor in expected.items():
        assert found[name].shape == tensor.shape and found[name].dtype == tensor.dtype
        if not tensor.numel():
            continue
        if name == "means":
            logs = lambda x: torch.sign(x) * torch.log1p(x.abs())
            found[name], tensor = logs(found[name]), logs(tensor)
        steps = {"means": 2**16 - 1, "shN": 2**6 - 1}.get(name, 2**8 - 1)
        assert (found[name] - tensor).abs().max() <= 0.51 * (tensor.max() - tensor.min()) / steps


def test_png_compression_drops_most_transparent_splats_to_square_count(tmp_path, caplog):
    given = splats(28)
    with caplog.at_level(logging.WARNING):
        PngCompression().compress(str(tmp_path), given)
    assert "3 of 28 splats" in caplog.text
    found = PngCompression().decompress(str(tmp_path))
    kept = {tuple(row.tolist()) for row in found["features"]}
    left = torch.tensor([tuple(row.tolist()) not in kept for row in given["features"]])
    assert left.sum() == 3
    assert given["opacities"][left].max() < given["opacities"][~left].min()


def test_png_compression_file_names_and_meta_equal_gsplat(tmp_path):
    PngCompression().compress(str(tmp_path), splats())
    pictures = {f"{name}.png" for name in ("means_l", "means_u", "scales", "quats", "opacities", "sh0")}
    assert {path.name for path in tmp_path.iterdir()} == {*pictures, "shN.npz", "features.npz", "meta.json"}
    meta = json.loads((tmp_path / "meta.json").read_text())
    assert meta["scales"]["shape"] == [25, 3] and len(meta["scales"]["mins"]) == 3 and meta["shN"]["quantization"] == 6


def test_clustered_centroids_are_means_of_clusters():
    generator = torch.Generator().manual_seed(0)
    middles = 10 * torch.randn(6, 5, generator=generator)
    rows = (middles[:, None] + 0.01 * torch.randn(6, 20, 5, generator=generator)).reshape(-1, 5)
    centroids, labels = png_compression.clustered(rows, 6)
    torch.testing.assert_close(centroids[labels], middles.repeat_interleave(20, 0), rtol=0, atol=0.05)
    again, _ = png_compression.clustered(rows, 6)
    assert torch.equal(again, centroids)


def test_clustered_in_two_levels_keeps_close_rows_together(monkeypatch):
    monkeypatch.setattr(png_compression, "COARSE", 4)
    generator = torch.Generator().manual_seed(0)
    middles = 10 * torch.randn(12, 5, generator=generator)
    rows = (middles[:, None] + 0.01 * torch.randn(12, 30, 5, generator=generator)).reshape(-1, 5)
    rows = rows[torch.randperm(len(rows), generator=generator)]
    centroids, labels = png_compression.clustered(rows, 100)
    assert len(centroids) <= 100
    assert (centroids[labels] - rows).norm(dim=1).max() < 0.1


def test_png_compress_refuses_invalid_splats(tmp_path):
    given = splats()
    with pytest.raises(InvalidInput, match="lack shN"):
        PngCompression().compress(str(tmp_path), {name: given[name] for name in given if name != "shN"})
    with pytest.raises(InvalidInput, match="no splats"):
        PngCompression().compress(str(tmp_path), {name: tensor[:0] for name, tensor in given.items()})
    given["scales"][3, 1] = torch.nan
    with pytest.raises(InvalidInput, match="scales must have 25 rows of finite values"):
        PngCompression().compress(str(tmp_path), given)


def test_png_decompress_refuses_damaged_folder(tmp_path):
    with pytest.raises(BundleCorrupt, match=r"meta\.json"):
        PngCompression().decompress(str(tmp_path))
    PngCompression().compress(str(tmp_path), splats())
    (tmp_path / "sh0.png").write_bytes(b"no picture")
    with pytest.raises(BundleCorrupt, match="sh0"):
        PngCompression().decompress(str(tmp_path))


def arguments(values: dict[str, torch.Tensor]) -> list[torch.Tensor]:
    return [values[name] for name in ("means", "scales", "quats", "opacities", "sh0", "shN")]


@pytest.mark.parametrize("format", ["ply", "ply_compressed"])
def test_export_splats_ply_round_trip(tmp_path, format: str):
    given, path = splats(), tmp_path / "splats.ply"
    given["means"][4, 0] = torch.inf
    given["opacities"][5] = -9
    data = export_splats(*arguments(given), format=format, save_to=str(path))
    assert path.read_bytes() == data
    found = load_ply(path)
    if format == "ply":
        kept = torch.arange(25) != 4
        torch.testing.assert_close(found.means, given["means"][kept])
        torch.testing.assert_close(found.sh, torch.cat([given["sh0"], given["shN"]], 1)[kept])
        torch.testing.assert_close(found.log_scales, given["scales"][kept])
    else:
        assert found.count == 23
        nearest = torch.cdist(found.means, given["means"].nan_to_num(posinf=1e6)).min(1).values
        assert nearest.max() < 0.02


def test_export_splats_splat_format_has_32_bytes_per_splat():
    data = export_splats(*arguments(splats()), format="splat")
    assert len(data) == 32 * 25
    assert np.frombuffer(data, "<f4").reshape(25, 8)[:, 3:6].min() > 0
    with pytest.raises(InvalidInput, match="unknown format 'glb'"):
        export_splats(*arguments(splats()), format="glb")
