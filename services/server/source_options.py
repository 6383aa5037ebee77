"""Options in source addresses, checked when a stream is created, before the capture process opens
the source.

The source modules load OpenCV and the control plane does not, so their options are repeated here. A
test compares both.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from gsplat_core.errors import InvalidSetting
from operators.settings import MAX_SEED
from operators.sources.address import Address
from operators.sources.options import MAX_FPS, MAX_SPEED, StereoLayout
from operators.sources.registry import split_address
from operators.sources.url_address import PROTOCOLS, UrlAddress

Check = Callable[[Address, str], object]


def _number(least: float, most: float) -> Check:
    return lambda address, name: address.number(name, None, least, most)


def _whole(least: int, most: int) -> Check:
    return lambda address, name: address.whole(name, None, least, most)


def _choice(*words: str) -> Check:
    return lambda address, name: name not in address.options or address.choice(name, words[0], words)


def _flag(address: Address, name: str) -> bool:
    return address.flag(name)


def _size(address: Address, name: str) -> object:
    return address.size(name)


def _text(address: Address, name: str) -> object:
    return address.text(name)


def _or_word(word: str, check: Check) -> Check:
    return lambda address, name: address.text(name) == word or check(address, name)


FPS, OPEN_S = _number(0.01, MAX_FPS), _number(0.1, 600.0)
OPTIONS: Mapping[str, Mapping[str, Check]] = {
    "synthetic": {
        "width": _whole(32, 4096),
        "height": _whole(32, 4096),
        "fps": _number(1, 240),
        "seed": _whole(0, MAX_SEED),
        "moving": _flag,
        "eyes": _whole(1, 2),
        "frames": _whole(1, 1000),
    },
    "v4l2": {"size": _size, "fps": FPS, "format": _text},
    "folder": {"fps": FPS, "every": _flag, "open_s": OPEN_S},
    "pipe": {"size": _size, "format": _text, "fps": FPS},
    "realtime": {
        "loop": _or_word("bounce", _flag),
        "speed": _or_word("max", _number(0.01, MAX_SPEED)),
        "fps": FPS,
    },
    "zmq+tcp": {"fps": FPS, "open_s": OPEN_S, "server": _text, "client": _text},
    "zmq+ipc": {"fps": FPS, "open_s": OPEN_S, "server": _text, "client": _text},
}


def check_source_options(address: str) -> None:
    """Check the options in a source address.

    Raises:
        InvalidSetting: if the source would refuse an option; the message names it.
    """
    if address.startswith("stereo:"):
        for eye in address.removeprefix("stereo:").split("|"):
            check_source_options(eye)
        return
    scheme, rest = split_address(address)
    if scheme in PROTOCOLS:
        place, hash_, fragment = rest.partition("#")
        kept = _without_layout(scheme, fragment)
        UrlAddress.parse(scheme, f"{place}{hash_}{kept}")
        return
    if scheme not in OPTIONS:
        return
    place, mark, query = rest.partition("?")
    given = Address.parse(scheme, f"{place}{mark}{_without_layout(scheme, query)}")
    for name, check in OPTIONS[scheme].items():
        check(given, name)
    given.refuse_others()


def _without_layout(scheme: str, query: str) -> str:
    """Remove `stereo=LAYOUT`, which every source accepts, from the options."""
    layouts = StereoLayout.__args__  # type: ignore[attr-defined]
    kept = []
    for pair in query.split("&"):
        name, _, value = pair.partition("=")
        if name != "stereo":
            kept.append(pair)
        elif value not in layouts:
            raise InvalidSetting(f"{scheme}: stereo is {value!r:.60}; choose {' or '.join(layouts)}")
    return "&".join(kept)
