"""Log of a benchmark of one method: figures with command, commit, machine and date as one JSON file."""

from __future__ import annotations

import argparse
import datetime
import json
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import suite

FOLDER = Path(__file__).resolve().parents[1] / "logs" / "methods"


def options(description: str) -> argparse.ArgumentParser:
    """Return a parser with the options of every method's benchmark."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--out", type=Path, help="JSON file; none is written without it")
    parser.add_argument("--full", action="store_true", help="sizes for a GPU")
    return parser


def write(method: str, chosen: argparse.Namespace, figures: Mapping[str, Any], folder: str = "methods") -> None:
    """Print the figures, and write them to `chosen.out` with command, commit, machine and date.

    Args:
        method: name of the script.
        chosen: its options.
        figures: values of the log.
        folder: folder of the script in `benchmarks`.
    """
    for name, value in figures.items():
        print(f"{name:44s} {value}")
    if chosen.out is None:
        return
    stated = re.sub(r" --out \S+", "", " ".join(["python", f"benchmarks/{folder}/{method}.py", *sys.argv[1:]]))
    stated = re.sub(r"\S*/recordings/", "{recordings}/", stated)
    stated = re.sub(r"(?<= )/(?:\S*/)?([^/\s]+)", r"{\1}", stated)  # other folders of this machine
    about = {
        "benchmark": f"{folder}/{method}",
        "command": stated,
        "commit": suite.commit(),
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "machine": suite.machine("cuda" if chosen.device.startswith("cuda") else "cpu"),
    }
    chosen.out.parent.mkdir(parents=True, exist_ok=True)
    chosen.out.write_text(json.dumps({**about, **figures}, indent=1) + "\n", encoding="utf-8")
