"""The model viewer with viser: served page and splats, sharing, slider, and view transforms."""

from __future__ import annotations

import struct
import urllib.request
from dataclasses import replace

import numpy as np
import pytest
import torch

from gsplat_core.io.bundle import save_bundle
from gsplat_core.models import Model
from gsplat_core.ops.covariance import quat_scale_to_covar_preci
from services.cli.models import bundle_in
from services.errors import Rejected
from services.model_view import DISTANCE, ModelView, rotation_matrices, scene_to_view
from services.registry.bundle_file import pack
from tests.gsplat_core.io.exports.test_exports import random_model
from tests.services.supervisor.test_model_show import uniform

viser = pytest.importorskip(
    "viser",
    reason="viser is not installed (extra viser): its releases ask for older rich and websockets than the lock has",
)
zstandard = pytest.importorskip("zstandard")
sync_client = pytest.importorskip("websockets.sync.client")


@pytest.fixture
def view():
    with ModelView(uniform((0.9, 0.1, 0.1)), "127.0.0.1", 18080) as made:
        yield made


def test_viser_server_sends_page_and_splats(view):
    address = f"127.0.0.1:{view.address[1]}"
    page = urllib.request.urlopen(f"http://{address}/", timeout=300).read()
    assert b"<html" in page
    protocol = f"viser-v{viser.__version__}"
    with sync_client.connect(f"ws://{address}/", subprotocols=[protocol], max_size=None) as socket:
        message = socket.recv(timeout=300)
    _, packed_size = struct.unpack_from("<QQ", message)
    said = zstandard.ZstdDecompressor().decompress(message[16 : 16 + packed_size], max_output_size=1 << 24)
    assert b"GaussianSplatsMessage" in said and b"/model" in said
    # 32 bytes a Gaussian, which begin with its centre.
    centres = view._splats(3.0)["centers"]
    assert len(message) > 32 * len(centres)
    first = message.index(centres[0].astype("<f4").tobytes())
    second = message.index(centres[1].astype("<f4").tobytes())
    assert second - first == 32


def test_viser_share_url_request_is_refused(view, monkeypatch, caplog):
    monkeypatch.setattr("viser._viser.ViserTunnel", None)  # what would open the way out
    message = viser._messages.ShareUrlRequest()
    (asked,) = view._server._websock_server._incoming_handlers[type(message)]
    address = f"127.0.0.1:{view.address[1]}"
    with sync_client.connect(f"ws://{address}/", subprotocols=[f"viser-v{viser.__version__}"], max_size=None) as socket:
        socket.recv(timeout=300)
        asked(0, message)
        assert view._server.request_share_url() is None
    assert view._server._share_tunnel is None and "public address" in caplog.text


def test_splats_match_model_in_camera_axes_at_distance(view):
    model = random_model(field=True)
    pose = np.array([[0.0, -1, 0, 3], [1, 0, 0, -2], [0, 0, 1, 60], [0, 0, 0, 1]])
    model = Model(1, model.gaussians, model.field, model.camera.with_pose(pose), model.time_window_s)
    view._model, view._place = model, scene_to_view(model)
    splats, now = view._splats(1.75), model.at(1.75)
    scale = view._place[2]
    seen = now.means.double().numpy() @ pose[:3, :3].T + pose[:3, 3]
    np.testing.assert_allclose(splats["centers"], scale * seen, rtol=1e-4, atol=1e-4)
    still = model.gaussians.means.double().numpy() @ pose[2, :3] + pose[2, 3]
    assert scale * np.median(still[still > 0]) == pytest.approx(DISTANCE)
    covariances, _ = quat_scale_to_covar_preci(now.quats, now.scales, compute_preci=False)
    turned = scale**2 * pose[:3, :3] @ covariances.double().numpy() @ pose[:3, :3].T
    np.testing.assert_allclose(splats["covariances"], turned, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(splats["opacities"][:, 0], now.logit_opacities.sigmoid(), atol=1e-6)


def test_time_slider_redraws_moving_model(view):
    model = random_model(field=True)
    with ModelView(model, "127.0.0.1", 18090) as moving:
        assert not moving._time.disabled and moving._drawn_s == 3.0
        moving._time.value = 1.5
        looks = iter([False, False, True])
        moving.run(lambda: next(looks))
        assert moving._drawn_s == 1.5
    assert view._time.disabled and view._play.disabled  # a model without a field stands still


def test_rotation_matrices_of_known_quaternions():
    half = np.sqrt(0.5)
    turn = rotation_matrices(np.array([[half, 0, 0, half], [1, 0, 0, 0]], np.float32))
    np.testing.assert_allclose(turn[0] @ [1, 0, 0], [0, 1, 0], atol=1e-6)
    np.testing.assert_allclose(turn[1], np.eye(3), atol=1e-6)


def test_scene_to_view_scale_is_1_for_scene_behind_camera():
    model = uniform((0.5, 0.5, 0.5))
    behind = replace(model.gaussians, means=model.gaussians.means * torch.tensor([1.0, 1.0, -1.0]))
    assert scene_to_view(Model(1, behind, None, model.camera, (0.0, 1.0)))[2] == 1.0


def test_bundle_in_unpacks_isplat_file(tmp_path):
    save_bundle(uniform((0.9, 0.1, 0.1)), tmp_path / "model")
    pack(tmp_path / "model", tmp_path / "x.isplat")
    with bundle_in(tmp_path / "model") as folder:
        assert folder == tmp_path / "model"
    with bundle_in(tmp_path / "x.isplat") as folder:
        assert sorted(path.name for path in folder.iterdir()) == ["manifest.json", "model.safetensors"]
    (tmp_path / "y.isplat").write_bytes(b"PK\x03\x04")
    with pytest.raises(Rejected), bundle_in(tmp_path / "y.isplat"):
        pass
