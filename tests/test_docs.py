"""Documents agree with the program: links, commands, flags, routes, settings and files exist; no private places are named."""

from __future__ import annotations

import ast
import importlib
import json
import pkgutil
import re
import shlex
import subprocess
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import typer
import yaml
from fastapi import APIRouter

from gsplat_core import Camera, Frame, Gaussians
from gsplat_core.io.bundle import manifest_bytes, parse_manifest
from gsplat_core.io.recordings import open_recording
from gsplat_core.io.recordings.truth import open_views
from gsplat_core.models import Model
from operators.graph import Application, Operator, OperatorSpec
from operators.ingest import SourceOp
from operators.sinks.sink import CallbackSinkOp
from operators.sources.source import SourceDescription, ThreadedSource
from services import api as service_routes
from services.cli.app import app
from services.settings import ServiceSettings

ROOT = Path(__file__).resolve().parent.parent
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
CODE_BLOCK = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
MACHINE_PLACES = re.compile(
    r"(?<![\w.])/(?:home|Users|root|work|workspace|mnt|private)/\w"  # somebody's folder
    r"|https?://(?!127\.|localhost)[^\s/\"'<>]*(?:\d{1,3}(?:\.\d{1,3}){3}|\.internal|\.local|\.corp|proxy|mirror|artifactory|nexus)\b"
    r"|--(?:extra-)?index-url[= ]\S"
)
TEXT_SUFFIXES = {".py", ".md", ".toml", ".lock", ".cpp", ".h", ".txt", ".css", ".yaml", ".yml", ".json", ".sh", ""}


@cache
def tracked() -> tuple[Path, ...]:
    """Return files under version control; in an archive without git, every file that git would not ignore by name."""
    try:
        listed = subprocess.run(["git", "ls-files"], cwd=ROOT, check=True, capture_output=True, text=True).stdout
        names = [ROOT / line for line in listed.splitlines()]
    except (OSError, subprocess.CalledProcessError):
        skipped = {".venv", "build", "out", "dist", "__pycache__"}
        names = [path for path in ROOT.rglob("*") if not skipped & set(path.relative_to(ROOT).parts)]
    return tuple(path for path in names if path.is_file())


DOCUMENTS = [path for path in tracked() if path.suffix == ".md"]


def anchors(document: Path) -> set[str]:
    """Return the anchors of a document's headings, as repository hosts generate them."""
    text = CODE_BLOCK.sub("", document.read_text(encoding="utf-8"))
    headings = re.findall(r"^#+ +(.+?) *$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_relative_links_resolve(document):
    broken = []
    for target in LINK.findall(CODE_BLOCK.sub("", document.read_text(encoding="utf-8"))):
        if re.match(r"[a-z]+:", target):
            continue
        name, _, anchor = target.partition("#")
        file = document.parent / name if name else document
        if not file.exists() or (anchor and anchor not in anchors(file)):
            broken.append(target)
    assert broken == []


def commands() -> dict[str, set[str]]:
    """Return the options per command. A group includes its commands' options; the program's own are under the empty name."""
    group = program()
    options = {name: {"--help"} for name in ["", *group.commands]}
    for name, command in [("", group), *group.commands.items()]:
        waiting = [command]
        while waiting:
            each = waiting.pop()
            waiting += getattr(each, "commands", {}).values() if name else ()
            for parameter in each.params:
                options[name] |= {*parameter.opts, *parameter.secondary_opts}
    return options


def command_lines(document: Path) -> list[str]:
    """Return the arguments after `intrasplat` in code blocks and inline code."""
    text = document.read_text(encoding="utf-8").replace("\\|", "|")  # tables escape their bars
    code = "\n".join([*CODE_BLOCK.findall(text), *re.findall(r"`([^`\n]+)`", CODE_BLOCK.sub("", text))])
    return re.findall(r"^(?:\S*/)?intrasplat +(\S.*)$", code, re.MULTILINE)


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_commands_and_flags_exist(document):
    known = commands()
    for line in command_lines(document):
        first = line.split()[0]
        command = "" if first.startswith("--") else first
        assert command in known, f"intrasplat {line}: there is no command {command}"
        unknown = set(re.findall(r"--[a-z-]+", line)) - known[command]
        assert not unknown, f"intrasplat {line}: {command} has no {unknown}"


@cache
def program() -> Any:
    """Return the definition of the command line."""
    return typer.main.get_command(app)


def misuse(line: str) -> str | None:
    """Return why a command line does not parse, or None. Values are not converted, since RECORDING stands for a path."""
    command = program()
    words = shlex.split(line.partition(" #")[0].partition(" > ")[0].partition(" | ")[0])
    while getattr(command, "commands", None):
        if not words or words[0] not in command.commands:
            return f"there is no command {words[:1]}"
        command = command.commands[words.pop(0)]
    arguments = [each for each in command.params if each.param_type_name == "argument"]
    options = {
        name: each for each in command.params if each not in arguments for name in (*each.opts, *each.secondary_opts)
    }
    given = 0
    while words:
        word = words.pop(0)
        if not word.startswith("--"):
            given += 1
        elif word == "--help":
            return None
        elif word.partition("=")[0] not in options:
            return f"there is no option {word}"
        elif not options[word.partition("=")[0]].is_flag and "=" not in word:
            if not words or words[0].startswith("--"):
                return f"{word} has no value"
            words.pop(0)
    least = sum(each.required for each in arguments)
    most = 1000 if any(each.nargs == -1 for each in arguments) else len(arguments)
    missing = [name for name, each in options.items() if each.required and name not in line]
    if missing:
        return f"{missing[0]} is missing"
    return None if least <= given <= most else f"{given} arguments where {least} to {most} are taken"


GUIDES = [
    path for path in DOCUMENTS if path.name != "CHANGELOG.md" and "benchmarks" not in path.relative_to(ROOT).parts
]


@pytest.mark.parametrize("document", GUIDES, ids=lambda path: str(path.relative_to(ROOT)))
def test_command_lines_in_code_blocks_parse(document):
    blocks = "\n".join(CODE_BLOCK.findall(document.read_text(encoding="utf-8")))
    lines = re.findall(r"^(?:\S*/)?intrasplat +(\S.*)$", blocks, re.MULTILINE)
    assert [(line, misuse(line)) for line in lines if misuse(line)] == []


@pytest.mark.parametrize(
    "line",
    [
        "replays RECORDING --out DIR",
        "replay RECORDING --outt DIR",
        "replay RECORDING",
        "replay --out DIR",
        "replay RECORDING OTHER --out DIR",
        "replay RECORDING --out",
        "ctl streams --stream x",
        "ctl delete",
    ],
)
def test_command_lines_that_do_not_parse_are_noticed(line):
    assert misuse(line)


@cache
def routes() -> tuple[tuple[str, str], ...]:
    """Return method and path of each route of the service; WebSockets start as GET."""
    routers: list[Any] = []
    for module in pkgutil.iter_modules(service_routes.__path__):
        found = importlib.import_module(f"{service_routes.__name__}.{module.name}")
        routers += [route for each in vars(found).values() if isinstance(each, APIRouter) for route in each.routes]
    return tuple((method, route.path) for route in routers for method in (getattr(route, "methods", None) or {"GET"}))


def test_rest_paths_that_documents_name_exist():
    unknown = []
    for document in GUIDES:
        code = document.read_text(encoding="utf-8")
        for method, path in re.findall(
            r"(?:\b(GET|PUT|POST|PATCH|DELETE) )?(?:\$URL)?(/v1/[A-Za-z0-9{}_/-]*[A-Za-z0-9}])", code
        ):
            pattern = re.sub(r"\{[^}]*\}", "x", path)
            fits = [
                each
                for each, route in routes()
                if re.fullmatch(re.sub(r"\{[^}]*\}", "[^/]+", f"/v1{route.removeprefix('/v1')}"), pattern)
            ]
            if not fits or (method and method not in fits):
                unknown.append(f"{document.name}: {method} {path}")
    assert unknown == []


def test_settings_that_documents_name_exist():
    schema = ServiceSettings.model_json_schema()
    unknown = []
    for document in GUIDES:
        text = document.read_text(encoding="utf-8")
        for name in re.findall(r"`([a-z_]+(?:\.[a-z_]+)+)(?:: [^`]*)?`", text):
            section, *keys = name.split(".")
            here = schema["properties"].get(section)
            for key in keys if here is not None and section not in {"streams", "version"} else ():
                reference = next((each["$ref"] for each in (here, *here.get("anyOf", ())) if "$ref" in each), None)
                here = schema["$defs"][reference.rpartition("/")[2]] if reference else here
                here = here.get("properties", {}).get(key)
                if here is None:
                    unknown.append(f"{document.name}: {name}")
                    break
    assert [
        each for each in unknown if not each.endswith((".head", ".anchor", ".jsonl", ".sqlite", ".crt", ".key"))
    ] == []  # files


def test_the_settings_in_the_guide_are_accepted():
    text = (ROOT / "docs" / "service.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```yaml\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    assert len(blocks) == 2
    for block in blocks:
        ServiceSettings(**yaml.safe_load(block))


def test_python_in_documents_imports_what_exists():
    for document in GUIDES:
        for block in re.findall(
            r"^```python\n(.*?)^```", document.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
        ):
            for node in ast.walk(ast.parse(block)):
                module = node.module or "" if isinstance(node, ast.ImportFrom) else ""
                if isinstance(node, ast.ImportFrom) and module.startswith(("gsplat_core", "operators.", "services.")):
                    for each in node.names:
                        assert hasattr(importlib.import_module(module), each.name), f"{document.name}: {each.name}"


def test_the_training_program_in_the_guide_works(tmp_path):
    for number in range(2):
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.full((24, 32, 3), 90 + 10 * number, np.uint8))
    blocks = re.findall(
        r"^```python\n(.*?)^```", (ROOT / "docs" / "python-api.md").read_text(), re.MULTILINE | re.DOTALL
    )
    (program,) = (block for block in blocks if "observe(" in block)
    small = "ReconstructorConfig(gaussians=50, max_gaussians=100, steps_per_frame=1, first_frame_steps=1)"
    names: dict[str, Any] = {}
    exec(program.replace('"RECORDING"', repr(str(tmp_path))).replace("ReconstructorConfig()", small), names)
    assert names["frame"].seq == 1 and names["picture"].image.shape == (24, 32, 3)


def test_guides_state_no_measured_quality():
    """Measured figures belong in RESULTS.md, which is generated from logs, or in benchmarks/results. methods.md is a
    table of figures, each with its log. tuned_constants.md lists the measurements behind constants.
    """
    found = []
    for document in GUIDES:
        is_guide = "docs" in document.relative_to(ROOT).parts and "adr" not in document.parts
        if is_guide and document.name not in ("methods.md", "tuned_constants.md"):
            for figure in re.findall(r"\d+(?:\.\d+)? dB\b", document.read_text(encoding="utf-8")):
                if figure != "100 dB":  # the score of equal pictures
                    found.append(f"{document.name}: {figure}")
    assert found == []


def test_the_index_names_every_page():
    index = (ROOT / "docs" / "README.md").read_text(encoding="utf-8")
    pages = [path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")]
    unlisted = [
        page for page in pages if page != "README.md" and not page.startswith("adr/") and f"({page})" not in index
    ]
    assert unlisted == []


def test_files_that_documents_name_exist():
    """Covers paths from the root in every document, and names of Python modules in guides."""
    modules = {path.name for path in tracked()}
    built = {"gsplat_core/gsplat_core_cuda.so", "deploy/secrets/admin.key", "deploy/secrets/server.crt"}
    folders = "gsplat_core|operators|services|tests|benchmarks|examples|deploy|docker|docs"
    unknown = []
    for document in DOCUMENTS:
        text = document.read_text(encoding="utf-8")
        named = re.findall(rf"`((?:{folders})/[\w/.-]+)`", text)
        unknown += [f"{document.name}: {name}" for name in named if name not in built and not (ROOT / name).exists()]
        if document in GUIDES:
            named = re.findall(r"`(\w+\.py)`", text)
            unknown += [f"{document.name}: {name}" for name in named if name not in modules]
    assert unknown == []


def test_command_lines_are_found():
    assert "replay RECORDING --out DIR" in command_lines(ROOT / "README.md")


def test_flags_that_documents_name_alone_exist():
    every = set().union(*commands().values())
    for document in DOCUMENTS:
        for flag in re.findall(r"`(--[a-z-]+)[^`]*`", document.read_text(encoding="utf-8")):
            assert flag in every, f"{document.name} names {flag}, which no command has"


def test_the_readme_names_every_command():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert [name for name in commands() if name and not re.search(rf"\b{name}\b", text)] == []


def test_make_targets_exist():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"^([a-z]+):", makefile, re.MULTILINE))
    for document in DOCUMENTS:
        for name in re.findall(r"(?:`|^)make ([a-z]+)", document.read_text(encoding="utf-8"), re.MULTILINE):
            assert name in targets, f"{document.name}: there is no target {name}"


def test_decisions_are_numbered_without_gaps():
    decisions = sorted(path for path in (ROOT / "docs" / "adr").glob("*.md"))
    assert [int(path.name[:4]) for path in decisions] == list(range(1, len(decisions) + 1))
    for path in decisions:
        assert re.fullmatch(r"\d{4}(-[a-z0-9]+)+\.md", path.name)
        text = path.read_text(encoding="utf-8")
        assert text.startswith(f"# {path.name[:4]}: ")
        assert "**Decision.**" in text and "**Why.**" in text, path.name


def test_no_file_names_a_machine_or_a_registry():
    found = []
    for path in tracked():
        if path.suffix not in TEXT_SUFFIXES or path == Path(__file__).resolve():
            continue
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
            if MACHINE_PLACES.search(line):
                found.append(f"{path.relative_to(ROOT)}:{number}: {line.strip()[:100]}")
    assert found == []


@pytest.mark.parametrize(
    "line",
    [
        "see /home/somebody/x",
        "/" + "work/checkout",
        "https://pypi.internal/simple",
        "http://10.0.0.7:8080/simple",
        "--index-url https://host/simple",
        "https://mirror.example/simple",
    ],
)
def test_private_places_are_recognised(line):
    assert MACHINE_PLACES.search(line)


def test_every_locked_package_has_its_licence():
    text = (ROOT / "LICENSES.md").read_text(encoding="utf-8").lower()
    lock = "".join((ROOT / f"requirements{each}.lock").read_text(encoding="utf-8") for each in ("", "-service"))
    pinned = re.findall(r"^([A-Za-z0-9._-]+)==([^\s;\\]+)", lock, re.MULTILINE)
    assert pinned
    missing = [
        f"{name} {version}"
        for name, version in pinned
        if f"| {name} | {version} |".lower() not in text and f"{name} {version}".lower() not in text
    ]
    assert missing == [], "run `make licences`"


def json_examples(name: str) -> list[dict]:
    """Return the JSON blocks of a document."""
    text = (ROOT / "docs" / name).read_text(encoding="utf-8")
    return [json.loads(block) for block in re.findall(r"^```json\n(.*?)^```", text, re.MULTILINE | re.DOTALL)]


def test_the_calibration_files_in_the_guide_are_read_as_it_says(tmp_path):
    cameras, described, distorted, views = json_examples("recordings.md")
    assert set(distorted) == {*cameras, "distortion"} - {"model", "fps"}
    (tmp_path / "cameras" / "images").mkdir(parents=True)
    cv2.imwrite(
        str(tmp_path / "cameras" / "images" / "000000.png"),
        np.full((cameras["height"], cameras["width"], 3), 90, np.uint8),
    )
    (tmp_path / "cameras" / "cameras.json").write_text(json.dumps(cameras))
    recording = open_recording(tmp_path / "cameras")
    assert (recording.camera.K[0, 0], recording.fps, recording.fields) == (cameras["fx"], cameras["fps"], {"pose"})

    size = described["camera"]["height"], described["camera"]["width"]
    (tmp_path / "described" / "depth").mkdir(parents=True)
    cv2.imwrite(str(tmp_path / "described" / "000000.png"), np.full((*size, 3), 90, np.uint8))
    cv2.imwrite(str(tmp_path / "described" / "depth" / "000000.png"), np.full(size, 6000, np.uint16))
    (tmp_path / "described" / "recording.json").write_text(json.dumps(described))
    recording = open_recording(tmp_path / "described")
    frame = next(iter(recording))
    assert frame.depth is not None
    assert frame.depth.min() == pytest.approx(6000 * described["depth_unit_mm"])
    assert recording.camera.K[0, 0] == described["camera"]["fx"]

    view = views["views"][0]
    pictures = tmp_path / "described" / view["folder"] / "images"
    pictures.mkdir(parents=True)
    cv2.imwrite(
        str(pictures / "000000.png"), np.full((view["camera"]["height"], view["camera"]["width"], 3), 90, np.uint8)
    )
    (tmp_path / "described" / "views.json").write_text(json.dumps(views))
    (opened,) = open_views(tmp_path / "described", 1)
    assert (opened.name, opened.camera.K[0, 0]) == (view["name"], view["camera"]["fx"])
    assert opened.camera.world_to_camera.tolist() == view["left_to_view"]


def test_the_manifest_in_the_guide_is_one():
    (example,) = json_examples("design/bundle.md")
    example["training_digest"] = example["tensors"]["sha256"] = 64 * "0"
    manifest = parse_manifest(json.dumps(example).encode(), "docs/design/bundle.md")
    gaussians, field = manifest.skeleton()
    assert field is not None
    tensors = [*gaussians.tensors().values(), *field.state_dict().values()]
    assert sum(tensor.numel() for tensor in tensors) == example["parameters"]
    model = Model(
        1,
        Gaussians(*(torch.zeros_like(t, device="cpu") for t in gaussians.tensors().values())),
        None,
        manifest.camera,
        (0, 1),
        depth_source=manifest.depth_source,
    )
    assert set(example) == set(json.loads(manifest_bytes(model, 0, 64 * "0")))


def test_the_operator_in_the_guide_works():
    text = (ROOT / "docs" / "design" / "operators.md").read_text(encoding="utf-8")
    (source,) = re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    names: dict[str, Any] = {"Operator": Operator, "OperatorSpec": OperatorSpec, "Frame": Frame, "Any": Any}
    exec(source, names)
    seen: list[float] = []

    class Two(Application):
        def compose(self) -> None:
            source = SourceOp(self, name="source", source=_Frames())
            share = names["ToolShareOp"](self, name="share", only_every=2)
            self.add_flow(source, share)
            self.add_flow(share, CallbackSinkOp(self, name="show", callback=seen.append))

    Two().run()
    assert seen == [0.5, 0.5]


class _Frames(ThreadedSource):
    """Four frames, half tool."""

    description = SourceDescription("frames", 2, 1, 25.0, Camera.from_focal(1.0, 2, 1), frame_count=4)

    def frames(self):
        mask = np.array([[1, 0]], np.uint8)
        return (Frame(seq=i, pts_ns=i, image=np.zeros((1, 2, 3), np.uint8), mask=mask) for i in range(4))
