"""Server-side request forgery: sources named over the API are limited to those listed in the settings."""

from __future__ import annotations

import pytest

from services.api.problems import Unprocessable
from services.api.streams import check_source
from services.settings import SourceRules


@pytest.fixture
def rules(tmp_path):
    allowed = tmp_path / "recordings"
    (allowed / "sub").mkdir(parents=True)
    (tmp_path / "secret").mkdir()
    (allowed / "link").symlink_to(tmp_path / "secret")
    return SourceRules(
        schemes=("synthetic", "rtsp", "recording", "v4l2", "http", "stereo", "exec"),
        networks=("10.1.0.0/16", "fd00::/8"),
        hosts=("camera.theatre",),
        folders=(allowed,),
        devices=("/dev/video0",),
    )


@pytest.mark.parametrize(
    "address",
    [
        "synthetic:", "synthetic:?moving=1", "rtsp://10.1.2.3/stream", "rtsp://10.1.2.3:554/stream?x=1#transport=udp",
        "rtsp://user:pass@10.1.2.3/s", "rtsp://camera.theatre/s", "rtsp://[fd00::1]:554/s", "v4l2:/dev/video0?fps=30",
        "rtsp://[::ffff:10.1.2.3]/s", "stereo:rtsp://10.1.2.3/l|rtsp://10.1.2.3/r", "stereo:v4l2:/dev/video0|synthetic:",
    ],
)  # fmt: skip
def test_check_source_accepts_addresses_listed_in_settings(rules, address):
    check_source(address, rules)


@pytest.mark.parametrize(
    "address",
    [
        # other hosts, and other spellings of this one
        "rtsp://10.2.0.1/s", "rtsp://127.0.0.1/s", "rtsp://localhost/s", "rtsp://[::1]/s", "rtsp://0.0.0.0/s",
        "http:" + "//169.254.169.254/latest/meta-data", "rtsp://[::ffff:127.0.0.1]/s", "rtsp://2130706433/s", "rtsp://0x7f000001/s",
        "rtsp://127.1/s", "rtsp://0177.0.0.1/s", "rtsp://10.1.2.3.evil.example/s", "rtsp://evil.example/s",
        "rtsp://camera.theatre.evil.example/s", "rtsp://camera.theatre@evil.example/s", "rtsp://10.1.2.3@127.0.0.1/s",
        "rtsp://10.1.2.3%2f@127.0.0.1/s", "rtsp://a@10.1.2.3@127.0.0.1/s", "rtsp://127.0.0.1#@10.1.2.3/s",
        "rtsp://127.0.0.1?@10.1.2.3/s", "rtsp://127.0.0.1\\@10.1.2.3/s", "rtsp://127.0.0.1 @10.1.2.3/s", "rtsp://10.1.2.3\n/s",
        "rtsp:///s", "rtsp:10.1.2.3/s", "rtsp://", "rtsp://:554/s", "rtsp://10.1.2.3:99999/s", "rtsp://[10.1.2.3]/s",
        "rtsp://１０.1.2.3/s", "rtsp://10.1.2.3,127.0.0.1/s", "rtsp://[fe80::1%25eth0]/s",
        # unlisted or unknown schemes
        "file:///etc/passwd", "gopher://10.1.2.3/", "concat:/etc/passwd|/etc/shadow", "udp://10.1.2.3:1", "RTSP://10.1.2.3/s",
        "exec:/bin/sh", "zmq+tcp://10.1.2.3:5", "pipe:-", "", "10.1.2.3", "/etc/passwd", "rtsp",
        # paths
        "recording:/etc/passwd", "recording:///etc/passwd", "recording:../x", "recording:x", "v4l2:/dev/video1", "v4l2:/dev/mem",
        "v4l2:/dev/video0/../mem",
        # one good eye
        "stereo:rtsp://10.1.2.3/l|rtsp://127.0.0.1/r", "stereo:", "stereo:stereo:synthetic:|synthetic:", "stereo:rtsp://10.1.2.3/l|",
        "rtsp://10.1.2.3/" + 1000 * "a",
    ],
)  # fmt: skip
def test_check_source_refuses_unlisted_addresses(rules, address):
    with pytest.raises(Unprocessable):
        check_source(address, rules)


@pytest.mark.parametrize(
    ("place", "allowed"),
    [
        ("recordings/sub", True), ("recordings", True), ("recordings/../secret", False), ("recordings/link", False),
        ("recordings-of-others", False), ("secret", False), ("recordings/sub?/../../../secret", False),
        ("recordings/sub%2f..", False), ("recordings/sub#/../../../secret", False),
    ],
)  # fmt: skip
def test_check_source_accepts_recordings_in_listed_folders_only(rules, tmp_path, place, allowed):
    address = f"recording:{tmp_path}/{place}"
    if allowed:
        check_source(address, rules)
    else:
        with pytest.raises(Unprocessable):
            check_source(address, rules)


def test_default_source_rules_accept_synthetic_source_only():
    check_source("synthetic:", SourceRules())
    for address in ("rtsp://10.0.0.1/s", "v4l2:/dev/video0", "recording:/srv/x", "http:" + "//10.0.0.1/"):
        with pytest.raises(Unprocessable):
            check_source(address, SourceRules())
