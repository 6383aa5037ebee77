"""URLs and server responses that try to read local files or crash the process."""

from __future__ import annotations

import http.server
import threading

import pytest

from gsplat_core.errors import UserError
from operators.sources.registry import SourceOptions, open_source

HERE = SourceOptions(process=False)


@pytest.fixture(scope="module")
def secret(tmp_path_factory):
    """A local video that must not be reachable through a URL."""
    import av
    import numpy as np

    path = tmp_path_factory.mktemp("private") / "video.ts"
    with av.open(str(path), "w", format="mpegts") as out:
        stream = out.add_stream("mpeg4", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for k in range(10):
            out.mux(stream.encode(av.VideoFrame.from_ndarray(np.full((48, 64, 3), 9 * k, np.uint8), format="rgb24")))
        out.mux(stream.encode())
    return path


@pytest.fixture
def answering():
    """A server that answers every request with the same bytes or a redirect."""
    answer = {"body": b"", "type": "application/octet-stream", "location": None}

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(302 if answer["location"] else 200)
            if answer["location"]:
                self.send_header("Location", answer["location"])
            self.send_header("Content-Type", answer["type"])
            self.send_header("Content-Length", str(len(answer["body"])))
            self.end_headers()
            self.wfile.write(answer["body"])

        def log_message(self, *_):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        answer["url"] = f"http://127.0.0.1:{server.server_address[1]}/stream"
        yield answer
        server.shutdown()
        thread.join()


def refused(address):
    with pytest.raises(UserError) as raised:
        open_source(address, HERE).close()
    return str(raised.value)


@pytest.mark.parametrize(
    "address",
    [
        "file://{0}",
        "file:{0}",
        "concat://{0}",
        "subfile://,,start,0,end,0,,:{0}",
        "crypto://{0}",
        "cache:{0}",
        "async://{0}",
        "data://x",
        "fd://0",
        "lavfi://testsrc",
    ],
)
def test_unknown_url_schemes_do_not_reach_ffmpeg(address, secret):
    assert "unknown source" in (text := refused(address.format(secret))) or "there is no such file" in text


@pytest.mark.parametrize("scheme", ["tcp", "http", "udp", "rtsp"])
def test_nested_file_scheme_in_url_opens_no_file(scheme, secret):
    refused(f"{scheme}://file:{secret}")


@pytest.mark.parametrize(
    ("body", "kind"),
    [
        ("#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nfile://{0}\n#EXT-X-ENDLIST\n", "application/vnd.apple.mpegurl"),
        ("#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\n{0}\n#EXT-X-ENDLIST\n", "application/vnd.apple.mpegurl"),
        ("#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nconcat:{0}\n#EXT-X-ENDLIST\n", "application/vnd.apple.mpegurl"),
        ("ffconcat version 1.0\nfile {0}\n", "text/plain"),
        ("v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nm=video 0 file://{0} 96\n", "application/sdp"),
        ("<MPD><BaseURL>file://{0}</BaseURL></MPD>", "application/dash+xml"),
    ],
)
@pytest.mark.slow
def test_playlist_from_server_opens_no_local_file(answering, secret, body, kind):
    answering.update(body=body.format(secret).encode(), type=kind)
    refused(answering["url"])


@pytest.mark.parametrize("location", ["file://{0}", "{0}", "concat:{0}", "ftp://127.0.0.1/x"])
def test_http_redirect_opens_no_local_file(answering, secret, location):
    answering["location"] = location.format(secret)
    refused(answering["url"])


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"\x00" * 4096,
        b"\x47" * 188 * 40,
        b"GIF89a" + bytes(100),
        b"RIFF\xff\xff\xff\xffAVI ",
        b"\x1a\x45\xdf\xa3" + b"\xff" * 300,
    ],
)
@pytest.mark.slow
def test_response_that_is_no_video_raises_user_error(answering, body):
    answering["body"] = body
    assert "cannot be opened" in refused(answering["url"])


def test_video_sent_by_http_server_is_read(answering, secret):
    answering["body"] = secret.read_bytes()
    source = open_source(answering["url"], HERE)
    assert (source.description.width_px, source.description.height_px) == (64, 48)
    source.close()
