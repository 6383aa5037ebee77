"""gsplat's module names on top of this package."""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch

import gsplat_core
from gsplat_core import as_gsplat
from gsplat_core.as_gsplat import __main__ as run
from gsplat_core.as_gsplat import functions as utils
from gsplat_core.as_gsplat import install
from gsplat_core.ops.depth_to_normal import depth_to_normal
from gsplat_core.rendering.depth_maps import depth_to_points

PROGRAM = """
import sys
from helper import SIZE
import torch
from gsplat import rasterization
from gsplat.cuda._wrapper import spherical_harmonics
import gsplat

means = torch.tensor([[0.0, 0.0, 2.0]], requires_grad=True)
colors, alphas, meta = rasterization(
    means, torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 0.2), torch.tensor([0.9]), torch.ones(1, 3),
    torch.eye(4)[None], torch.tensor([[[20.0, 0, 8], [0, 20.0, 8], [0, 0, 1]]]), SIZE, SIZE,
)
colors.sum().backward()
assert means.grad.abs().sum() > 0
assert gsplat.rendering.rasterization is rasterization
print(__name__, gsplat.__version__, tuple(colors.shape), sys.argv[1:])
"""


@pytest.fixture
def installed(request):
    before = dict(sys.modules)
    install(getattr(request, "param", "1.6"))
    yield
    sys.meta_path[:] = [each for each in sys.meta_path if not isinstance(each, as_gsplat.Finder)]
    for name in as_gsplat.MODULES:
        sys.modules.pop(name, None)
        if name in before:
            sys.modules[name] = before[name]


@pytest.mark.slow
def test_as_gsplat_runs_program_with_modules_in_own_folder(tmp_path):
    (tmp_path / "helper.py").write_text("SIZE = 16\n")
    (tmp_path / "program.py").write_text(PROGRAM)
    command = [sys.executable, "-m", "gsplat_core.as_gsplat", str(tmp_path / "program.py"), "--steps", "3"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["__main__", "1.5.3", "(1,", "16,", "16,", "3)", "['--steps',", "'3']"]


SPAWNING = """
import multiprocessing
import sys

import fused_ssim
import gsplat
from gsplat.rendering import rasterization


def names(queue):
    queue.put((gsplat.__name__, rasterization.__module__, fused_ssim.fused_ssim.__module__, sys.argv[1]))


if __name__ == "__main__":
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    process = context.Process(target=names, args=(queue,))
    process.start()
    process.join()
    assert process.exitcode == 0
    print(*queue.get())
"""


@pytest.mark.slow
@pytest.mark.parametrize("constants", ["1.6", "1.5.3"])
def test_as_gsplat_spawned_processes_have_modules(tmp_path, constants):
    (tmp_path / "gsplat.py").write_text("raise ImportError('this folder has another gsplat')\n")
    (tmp_path / "program.py").write_text(SPAWNING)
    command = [
        sys.executable,
        "-m",
        "gsplat_core.as_gsplat",
        "--constants",
        constants,
        str(tmp_path / "program.py"),
        "x",
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    expected = ["gsplat", "gsplat_core.rendering.rasterization", "gsplat_core.ops.ssim", "x"]
    assert done.stdout.split() == expected


@pytest.mark.parametrize("constants", ["1.6", "1.5.3"])
def test_as_gsplat_hook_precedes_module_on_path(monkeypatch, constants):
    monkeypatch.setattr(sys, "meta_path", [each for each in sys.meta_path if not isinstance(each, as_gsplat.Finder)])
    monkeypatch.setenv("INTRASPLAT_GSPLAT_CONSTANTS", constants)
    monkeypatch.syspath_prepend(as_gsplat.PATH_ENTRY)
    for name in as_gsplat.MODULES:
        monkeypatch.delitem(sys.modules, name, raising=False)
    try:
        module = importlib.import_module("gsplat")
        assert isinstance(module, as_gsplat.AliasModule) and module.__spec__.loader.constants == constants
        assert importlib.import_module("fused_ssim").fused_ssim is gsplat_core.fused_ssim
    finally:
        for name in as_gsplat.MODULES:
            sys.modules.pop(name, None)


@pytest.mark.parametrize(
    ("program", "found"),
    [
        (["nowhere.py"], "nowhere.py does not exist"),
        (["."], ". is a folder without __main__.py"),
        (["-m", "no_such_module_of_ours"], "there is no module no_such_module_of_ours"),
        (["-m", "no_such_package.module"], "there is no module no_such_package.module"),
    ],
)
def test_as_gsplat_missing_program_is_argument_error(tmp_path, monkeypatch, capsys, program, found):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["as_gsplat", *program])
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(sys, "meta_path", list(sys.meta_path))
    monkeypatch.setenv("INTRASPLAT_GSPLAT_CONSTANTS", "")
    with pytest.raises(SystemExit) as ended:
        run.main()
    assert ended.value.code == 2 and found in capsys.readouterr().err


def test_as_gsplat_every_name_exists(installed):
    for module_name, homes in as_gsplat.MODULES.items():
        module = importlib.import_module(module_name)
        for name in homes:
            assert getattr(module, name) is not None, (module_name, name)
        assert set(homes) <= set(dir(module))


def test_as_gsplat_names_equal_package_names(installed):
    module = importlib.import_module("gsplat")
    for name in as_gsplat.MODULES["gsplat"]:
        if name in gsplat_core.__all__:
            assert getattr(module, name) is getattr(gsplat_core, name)


def test_as_gsplat_persp_proj_equals_pinhole_projection(installed):
    wrapper = importlib.import_module("gsplat.cuda._wrapper")
    splats = torch.tensor([[[0.1, 0.2, 2.0], [0.3, -0.1, 3.0]]]), torch.eye(3).expand(1, 2, 3, 3)
    K = torch.tensor([[[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]])
    expected = wrapper.proj(*splats, K, 16, 16, camera_model="pinhole")
    torch.testing.assert_close(wrapper.persp_proj(*splats, K, 16, 16), expected)


def test_as_gsplat_isect_offset_encode_accepts_plain_argument_names(installed):
    plain = importlib.import_module("gsplat.cuda._torch_impl")
    means2d, radii = torch.tensor([[[4.0, 4.0], [20.0, 4.0]]]), torch.full((1, 2, 2), 3, dtype=torch.int32)
    _, ids, _ = plain._isect_tiles(means2d, radii, torch.ones(1, 2), 16, 2, 1)
    assert plain._isect_offset_encode(isect_ids=ids, I=1, tile_width=2, tile_height=1).tolist() == [[[0, 1]]]


@pytest.mark.parametrize(("installed", "most"), [("1.6", 0.99), ("1.5.3", 0.999)], indirect=["installed"])
def test_as_gsplat_constants_of_chosen_version(installed, most):
    gsplat = importlib.import_module("gsplat")
    assert importlib.import_module("gsplat.rendering").rasterization is gsplat.rasterization
    opaque = torch.tensor([[0.0, 0, 2]]), torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 0.5), torch.ones(1)
    camera = torch.eye(4)[None], torch.tensor([[[20.0, 0, 8.5], [0, 20, 8.5], [0, 0, 1]]])
    _, alphas, meta = gsplat.rasterization(*opaque, torch.ones(1, 3), *camera, 16, 16, packed=False)
    assert float(alphas.max()) == pytest.approx(most)
    splats = meta["means2d"], meta["conics"], torch.ones(1, 1)
    lists = 16, 16, 16, meta["isect_offsets"], meta["flatten_ids"]
    pairs = gsplat.rasterize_to_indices_in_range(0, 1, torch.ones(1, 16, 16), *splats, *lists)
    _, accumulated = gsplat.accumulate(*splats, torch.ones(1, 1, 3), *pairs, 16, 16)
    torch.testing.assert_close(accumulated, alphas)
    with pytest.raises(ImportError, match="other constants"):
        install("1.5.3" if most == 0.99 else "1.6")


def test_as_gsplat_unknown_name_error_lists_existing_names(installed):
    module = importlib.import_module("gsplat.exporter")
    with pytest.raises(AttributeError, match=r"no attribute 'export_gltf'.*export_splats"):
        module.export_gltf  # noqa: B018
    with pytest.raises(ImportError, match=r"'sensors' in gsplat of gsplat_core: gsplat has .*rasterization.*strategy"):
        importlib.import_module("gsplat.sensors")
    with pytest.raises(ImportError, match=r"'export_gltf' in gsplat\.exporter of gsplat_core.*export_splats"):
        exec("from gsplat.exporter import export_gltf")
    with pytest.raises(ImportError, match=r"gsplat 0\.1, .*use gsplat\.rasterization"):
        exec("from gsplat.project_gaussians import project_gaussians")
    with pytest.raises(ImportError, match=r"gsplat 0\.1, .*use gsplat\.rasterization"):
        exec("from gsplat import rasterize_gaussians")
    with pytest.raises(ImportError, match=r"gsplat 0\.1, .*normalized_quat_to_rotmat for quat_to_rotmat"):
        exec("from gsplat.cuda_legacy._torch_impl import quat_to_rotmat")
    with pytest.raises(ImportError, match=r"gsplat 0\.1"):
        exec("from gsplat.utils import bin_and_sort_gaussians")
    with pytest.raises(AttributeError, match=r"'project_gaussians': it belongs to gsplat 0\.1"):
        importlib.import_module("gsplat").project_gaussians  # noqa: B018
    with pytest.raises(AttributeError, match=r"'compute_sh_forward': gsplat\.cuda has _backend"):
        importlib.import_module("gsplat.cuda").compute_sh_forward  # noqa: B018
    assert not hasattr(importlib.import_module("gsplat"), "rasterize_gaussians")


def test_as_gsplat_compiled_extension_functions_rejected_at_call(installed):
    extension = importlib.import_module("gsplat.cuda._backend")._C
    wrapper = importlib.import_module("gsplat.cuda._wrapper")
    assert extension is not None and not hasattr(extension, "CameraModelType")
    lazy = wrapper._make_lazy_cuda_func("rasterize_to_pixels_3dgs_fwd")
    with pytest.raises(AttributeError, match=r"'rasterize_to_pixels_3dgs_fwd' of gsplat's compiled extension; call"):
        lazy(torch.ones(1))
    with pytest.raises(AttributeError, match=r"'CameraModelType' of gsplat's compiled extension"):
        wrapper._make_lazy_cuda_obj("CameraModelType")


@pytest.mark.parametrize("name", ["strategy", "__version__"])
def test_gsplat_modules_without_hook_error_names_hook(name):
    with pytest.raises(AttributeError, match=rf"no attribute '{name}'; for gsplat's modules .*as_gsplat\.install\(\)"):
        getattr(gsplat_core, name)


def test_as_gsplat_provides_version_file_and_extension(installed):
    module = importlib.import_module("gsplat")
    assert importlib.metadata.version("gsplat") == module.__version__
    assert Path(module.__file__).is_file()
    assert importlib.util.find_spec("gsplat.csrc") is None
    importlib.reload(module)
    assert module.rasterization is gsplat_core.rasterization


def test_as_gsplat_provides_names_imported_by_gsplat_modules(installed):
    """Programs import some names from modules that do not define these names."""
    default = importlib.import_module("gsplat.strategy.default")
    assert default.remove is importlib.import_module("gsplat.strategy.ops").remove
    assert importlib.import_module("gsplat.rendering").depth_to_normal is depth_to_normal
    assert importlib.import_module("gsplat.compression.png_compression").log_transform is utils.log_transform
    operations = importlib.import_module("gsplat.strategy.ops")
    assert operations.quat_scale_to_covar_preci is importlib.import_module("gsplat").quat_scale_to_covar_preci
    plain = importlib.import_module("gsplat.cuda._torch_impl")
    assert importlib.import_module("gsplat.cuda._torch_impl_2dgs")._quat_scale_to_matrix is plain._quat_scale_to_matrix


def test_ply_file_round_trip(tmp_path):
    random = torch.Generator().manual_seed(0)
    draw = lambda *shape: torch.randn(*shape, generator=random)
    splats = {
        "means": draw(5, 3), "scales": draw(5, 3), "quats": draw(5, 4), "opacities": draw(5), "sh0": draw(5, 1, 3),
        "shN": draw(5, 8, 3),
    }  # fmt: skip
    gsplat_core.export_splats(**splats, save_to=tmp_path / "a.ply")
    read = utils.load_ply_to_splats(tmp_path / "a.ply")
    assert set(read) == set(splats)
    for name, tensor in splats.items():
        torch.testing.assert_close(read[name], tensor)
    flat = {**splats, "sh0": splats["sh0"][:, 0], "shN": splats["shN"].mT.reshape(5, 24)}
    assert utils.splat2ply_bytes(**flat) == (tmp_path / "a.ply").read_bytes()
    flat.pop("shN")
    assert utils.splat2splat_bytes(**flat) == gsplat_core.export_splats(**splats, format="splat")
    assert utils.sh2rgb(torch.zeros(2, 3)).tolist() == [[0.5] * 3] * 2


@pytest.mark.parametrize("kind", ["ply", "splat", "ply_compressed"])
@pytest.mark.parametrize("count", [0, 2])
def test_export_splats_without_visible_gaussians_writes_empty_file(tmp_path, kind, count):
    """`count` Gaussians have no finite position."""
    empty = {
        "means": torch.full((count, 3), torch.nan), "scales": torch.zeros(count, 3), "quats": torch.ones(count, 4),
        "opacities": torch.zeros(count), "sh0": torch.zeros(count, 1, 3), "shN": torch.zeros(count, 3, 3),
    }  # fmt: skip
    written = gsplat_core.export_splats(**empty, format=kind, save_to=tmp_path / "a.ply")
    assert written == b"" if kind == "splat" else b"element vertex 0\n" in written
    if kind == "ply":
        assert utils.load_ply_to_splats(tmp_path / "a.ply")["means"].shape == (0, 3)


def test_as_gsplat_does_not_replace_loaded_gsplat(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", ModuleType("gsplat"))
    with pytest.raises(ImportError, match="before the first import of gsplat"):
        install()


def test_depth_to_points_projects_back_to_pixels():
    K = torch.tensor([[20.0, 0, 7], [0, 22, 5], [0, 0, 1]])
    pose = torch.eye(4)
    pose[:3, :3] = utils.normalized_quat_to_rotmat(torch.tensor([0.5, 0.5, 0.5, 0.5]))
    pose[:3, 3] = torch.tensor([1.0, 2, 3])
    depths = 2 + torch.rand(8, 12, 1, generator=torch.Generator().manual_seed(0))
    points = depth_to_points(depths, pose, K)
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    torch.testing.assert_close(local[..., 2:], depths)
    pixels = (local @ K.T)[..., :2] / local[..., 2:]
    torch.testing.assert_close(pixels[3, 4], torch.tensor([4.5, 3.5]))
    along_ray = depth_to_points(depths, pose, K, z_depth=False)
    torch.testing.assert_close((along_ray - pose[:3, 3]).norm(dim=-1, keepdim=True), depths)


def test_depth_to_normal_of_plane():
    K = torch.tensor([[20.0, 0, 6], [0, 20, 4], [0, 0, 1]])
    normal = torch.nn.functional.normalize(torch.tensor([0.3, -0.2, -1.0]), dim=0)
    y, x = torch.meshgrid(torch.arange(8) + 0.5, torch.arange(12) + 0.5, indexing="ij")
    rays = torch.stack([(x - 6) / 20, (y - 4) / 20, torch.ones_like(x)], -1)
    depths = (-3 / (rays @ normal))[..., None]
    normals = depth_to_normal(depths, torch.eye(4), K)
    torch.testing.assert_close(normals[1:-1, 1:-1], normal.expand(6, 10, 3), rtol=1e-4, atol=1e-4)
    assert not normals[0].any()


def test_projection_matrix_maps_near_and_far_to_0_and_1():
    matrix = utils.get_projection_matrix(0.5, 10.0, 1.2, 0.8, device="cpu")
    edge = torch.tensor([0.5 * torch.tan(torch.tensor(0.6)), 0.5 * torch.tan(torch.tensor(0.4)), 0.5, 1.0])
    near = matrix @ edge
    torch.testing.assert_close(near[:3] / near[3], torch.tensor([1.0, 1.0, 0.0]))
    far = matrix @ torch.tensor([0.0, 0, 10, 1])
    torch.testing.assert_close(far[2] / far[3], torch.tensor(1.0))
    expected = "cuda" if torch.cuda.is_available() else "cpu"
    assert utils.get_projection_matrix(0.5, 10.0, 1.2, 0.8).device.type == expected


def test_log_transform_inverse():
    values = torch.linspace(-50, 50, 21, dtype=torch.float64)
    torch.testing.assert_close(utils.inverse_log_transform(utils.log_transform(values)), values)
