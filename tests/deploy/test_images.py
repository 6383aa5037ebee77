"""The Dockerfile copies existing files that reach the build, and its images have no compiler and no root user."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path, PurePosixPath

import pytest

ROOT = Path(__file__).resolve().parents[2]
DOCKERFILE = ROOT / "docker" / "Dockerfile"


def instructions() -> list[tuple[str, str]]:
    """Return each instruction and its arguments, with continued lines joined."""
    lines = [line for line in DOCKERFILE.read_text().splitlines() if not line.startswith("#")]
    text = re.sub(r"\\\n\s*", " ", "\n".join(lines))
    return [(name, rest.strip()) for name, _, rest in (line.partition(" ") for line in text.splitlines()) if name]


def stages() -> dict[str, tuple[str, list[tuple[str, str]]]]:
    """Return each build stage's base image and instructions."""
    found: dict[str, tuple[str, list[tuple[str, str]]]] = {}
    current: list[tuple[str, str]] = []
    for name, rest in instructions():
        if name == "FROM":
            base, stage = re.fullmatch(r"(\S+) AS (\S+)", rest).groups()  # type: ignore[union-attr]
            current = []
            found[stage] = base, current
        else:
            current.append((name, rest))
    return found


def lineage(stage: str) -> list[tuple[str, str]]:
    """Return the instructions of a stage and of its base stages."""
    base, own = stages()[stage]
    return [*(lineage(base) if base in stages() else []), *own]


def let_through(path: str) -> bool:
    """Return true if .dockerignore lets a path into the build. The last matching line decides."""
    passes = True
    for line in (ROOT / ".dockerignore").read_text().splitlines():
        if not line or line.startswith("#"):
            continue
        pattern = line.removeprefix("!")
        parents = [path, *map(str, PurePosixPath(path).parents)]
        if any(PurePosixPath("/", each).match(f"/{pattern}") for each in parents if each != "."):
            passes = line.startswith("!")
    return passes


def copied_from_the_repository() -> list[str]:
    return [
        source
        for name, rest in instructions()
        if name == "COPY" and not rest.startswith("--from=")
        for source in rest.split()[:-1]
    ]


def test_dockerfile_copies_existing_files_not_ignored():
    sources = copied_from_the_repository()
    assert {"services", "requirements-service.lock", "docker/healthcheck.py", "docker/install_packages.py"} <= set(
        sources
    )
    for source in sources:
        assert (ROOT / source).exists(), source
        assert let_through(source), source


@pytest.mark.parametrize("path", ["deploy/secrets/admin.key", ".git", "tests", "out", "shared", "key.pem", ".venv"])
def test_dockerignore_excludes_path(path):
    assert not let_through(path)


@pytest.mark.parametrize("stage", ["cpu", "cuda"])
def test_images_have_no_compiler_and_run_as_non_root(stage):
    steps = lineage(stage)
    installed = " ".join(rest for name, rest in steps if name == "RUN")
    assert "tini" in installed
    assert not re.search(r"\b(g\+\+|gcc|clang|build-essential|nvcc|cmake|requirements-cuda)\b", installed)
    assert [rest for name, rest in steps if name == "USER"][-1] == "10001:10001"
    assert [name for name, _ in steps if name == "HEALTHCHECK"] == ["HEALTHCHECK"]
    copied = [rest for name, rest in steps if name == "COPY" and "/opt/intrasplat " in rest]
    assert copied == [f"--from=trimmed-{stage} /opt/intrasplat /opt/intrasplat"]


def test_image_healthcheck_uses_probe_port():
    variables = dict(re.findall(r"\b([A-Z_]+)=(\S+)", DOCKERFILE.read_text()))
    assert variables["HEALTHCHECK_URL"] == f"http://127.0.0.1:{variables['INTRASPLAT_SERVER__PROBE_PORT']}/livez"


def test_image_uninstalls_build_tools():
    import tomllib

    tools = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]["build"]
    (removed,) = {rest for stage in ("trimmed-cpu", "trimmed-cuda") for _, rest in stages()[stage][1]}
    assert set(re.sub(r"pip uninstall --yes", "", removed).split()) == {re.split(r"[<>=]", tool)[0] for tool in tools}


def test_dockerfile_stages_copied_from_exist():
    named = re.findall(r"(?:--from=|from=)([\w-]+)", DOCKERFILE.read_text())
    assert set(named) == {f"{each}-{kind}" for each in ("packages", "trimmed", "wheel") for kind in ("cpu", "cuda")}
    assert set(named) <= set(stages())


def test_image_builds_cuda_wheel_as_make_cuda():
    (built,) = [rest for name, rest in stages()["wheel-cuda"][1] if name == "RUN"]
    makefile = (ROOT / "Makefile").read_text()
    for option in ("--require-hashes --no-deps --target", "requirements-cuda.lock", "INTRASPLAT_CUDA=ON"):
        assert option in built and option in makefile
    assert "build/cuda-toolkit" in built and "CUDA_TOOLKIT := build/cuda-toolkit" in makefile
    assert ("ARG", "CUDA_ARCHITECTURES=portable") in stages()["wheel-cuda"][1]


@pytest.fixture(scope="module")
def installing():
    """Return the module that installs the packages of the images."""
    spec = importlib.util.spec_from_file_location("install_packages", ROOT / "docker" / "install_packages.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_without_cuda_removes_only_cuda_packages(installing):
    lock = (ROOT / "requirements-service.lock").read_text()
    every = list(installing.requirements(lock))  # some packages are there once for each Python
    assert len(every) == len(re.findall(r"(?m)^[a-z0-9][^=\s]*==", lock)) > 50
    kept, version = installing.without_cuda(lock)
    left = list(installing.requirements(kept))
    assert left == [each for each in every if each in left] and len(left) > 50
    assert all("--hash=sha256:" in text for _, _, text in left)
    gone = {name: (number, text) for name, number, text in every if (name, number, text) not in left}
    assert {"torch", "triton", "nvidia-cublas", "nvidia-cudnn-cu13"} <= gone.keys() and version == gone["torch"][0]
    assert not gone.keys() & {name for name, _, _ in left}
    for name in gone.keys() - {"torch"}:  # nothing that stays asks for them
        asking = set(re.findall(r"(?m)^    #(?: via |   )([a-z0-9][a-z0-9._-]*)$", gone[name][1]))
        assert asking and asking <= gone.keys(), (name, asking)
    with pytest.raises(ValueError, match="no torch"):
        installing.without_cuda("numpy==2.0 \\\n    --hash=sha256:00\n")


def test_install_packages_runs_expected_pip_commands(installing, monkeypatch, tmp_path):
    lock = tmp_path / "requirements.lock"
    lock.write_text(
        "numpy==2.0 \\\n    --hash=sha256:00\ntorch==2.15.0 \\\n    --hash=sha256:11\ntriton==3.9.0 \\\n    --hash=sha256:22\n"
    )
    asked: list[tuple[str, ...]] = []
    written: list[str] = []

    def pip(*arguments: str) -> int:
        asked.append(arguments)
        if "-r" in arguments:
            written.append(Path(arguments[-1]).read_text())
        return 0

    monkeypatch.setattr(installing, "pip", pip)
    assert installing.main([str(lock), "--torch-index-url", ""]) == 0
    assert asked == [("install", "--require-hashes", "-r", str(lock))], "without an index: the lock as it is"
    asked.clear(), written.clear()
    assert installing.main([str(lock), "--torch-index-url", "https://index.example/cpu", "--torch-sha256", "ab"]) == 0
    (rest, torch, check) = asked
    assert rest[:3] == ("install", "--require-hashes", "--no-deps") and "--index-url" not in rest
    assert torch[:4] == ("install", "--no-deps", "--index-url", "https://index.example/cpu") and check == ("check",)
    assert written == ["numpy==2.0 \\\n    --hash=sha256:00\n", "torch==2.15.0+cpu --hash=sha256:ab\n"]
    monkeypatch.setattr(installing, "pip", lambda *arguments: 1)
    assert installing.main([str(lock), "--torch-index-url", "https://index.example/cpu"]) == 1, (
        "what fails fails the build"
    )


def test_torch_index_is_build_argument_of_cpu_image_only():
    steps = stages()["packages-cpu"][1]
    assert [rest.partition("=")[0] for name, rest in steps if name == "ARG"] == ["TORCH_INDEX_URL", "TORCH_SHA256"]
    (run,) = [rest for name, rest in steps if name == "RUN"]
    assert '--torch-index-url "${TORCH_INDEX_URL}"' in run and '--torch-sha256 "${TORCH_SHA256}"' in run
    assert not any(name == "ARG" for name, _ in stages()["packages-cuda"][1])


def test_dockerfile_passes_hadolint(tool):
    done = tool("hadolint", DOCKERFILE)
    assert done.returncode == 0 and not done.stdout, done.stdout
