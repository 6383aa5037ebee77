"""Compile gsplat from its PyPI wheel or a source archive for the local GPU, as a peer for timing.

    python -m pip download gsplat==1.5.3 --no-deps --only-binary :all: --dest build/peers
    python benchmarks/peers/build_gsplat.py build/peers/gsplat-1.5.3-py3-none-any.whl build/peers
    PYTHONPATH=build/peers python benchmarks/gpu_eager.py

1.5.3 is the newest version on PyPI (November 2026); for a later one give gsplat-VERSION.tar.gz instead of the wheel. For a GPU machine
without a network, put the archive into build/peers, which git ignores, and copy that folder.

Needs nvcc, ninja, a torch with CUDA, and jaxtyping and rich, which gsplat imports. The sources and the flags (-O3 -use_fast_math)
are the wheel's; the result is written next to gsplat's Python files, so that the folder can be copied to another machine of the same
kind. TORCH_CUDA_ARCH_LIST selects another GPU than the local one, MAX_JOBS the number of compilers. After an interruption the
same command continues.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
import zipfile
from pathlib import Path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("wheel", type=Path, help="gsplat-1.5.3-py3-none-any.whl, or gsplat-VERSION.tar.gz")
    parser.add_argument("folder", type=Path, help="where the package is unpacked and built")
    options = parser.parse_args()
    start = time.perf_counter()
    build(options.wheel, options.folder.resolve())
    subprocess.run(
        [sys.executable, "-c", "import gsplat.csrc; print('gsplat', gsplat.__version__, gsplat.csrc.__file__)"],
        env=os.environ | {"PYTHONPATH": f"{options.folder.resolve()}:{os.environ.get('PYTHONPATH', '')}"},
        check=True,
    )
    print(f"built in {time.perf_counter() - start:.0f} s")


def unpack(archive: Path, folder: Path) -> None:
    """Put the package `gsplat` of a wheel or a source archive into `folder`."""
    if archive.suffix == ".whl":
        zipfile.ZipFile(archive).extractall(folder)
        return
    with tarfile.open(archive) as files, tempfile.TemporaryDirectory(dir=folder) as unpacked:
        files.extractall(unpacked, filter="data")
        (package,) = Path(unpacked).glob("*/gsplat")
        shutil.move(package, folder / "gsplat")


def build(wheel: Path, folder: Path) -> None:
    """Unpack the wheel into `folder` and compile its extension to `gsplat/csrc.so` there."""
    from torch.utils.cpp_extension import load

    if not (folder / "gsplat").exists():
        unpack(wheel, folder)
    os.environ.setdefault("MAX_JOBS", str(os.cpu_count() or 1))
    cuda, objects = folder / "gsplat" / "cuda", folder / "objects"
    objects.mkdir(exist_ok=True)
    load(
        name="csrc",  # gsplat tries `from gsplat import csrc` before it compiles anything itself
        sources=[str(path) for path in sorted([*cuda.glob("csrc/*.cu"), *cuda.glob("csrc/*.cpp"), cuda / "ext.cpp"])],
        extra_cflags=["-O3", "-Wno-attributes"],
        extra_cuda_cflags=["-O3", "-use_fast_math"],
        extra_include_paths=[str(cuda / "include"), str(cuda / "csrc" / "third_party" / "glm")],
        build_directory=str(objects),
        is_python_module=False,
    )
    subprocess.run(["strip", "--strip-unneeded", "-o", folder / "gsplat" / "csrc.so", objects / "csrc.so"], check=True)


if __name__ == "__main__":
    main()
