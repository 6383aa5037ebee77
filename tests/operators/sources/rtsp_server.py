"""An RTSP server (GStreamer's), for the tests: `python3 rtsp_server.py PORT [USER:PASSWORD]`.

It runs under the system's Python, which has GStreamer's bindings. `/camera` is 320x240 at 25 frames/s in H.264, `/small` 160x120, `/motion` JPEG pictures.
"""

from __future__ import annotations

import sys

import gi

gi.require_version("Gst", "1.0")
gi.require_version("GstRtspServer", "1.0")
from gi.repository import GLib, Gst, GstRtspServer  # noqa: E402

CAMERA = "videotestsrc is-live=true pattern=ball ! video/x-raw,format=I420,width={},height={},framerate=25/1 ! "
H264 = "x264enc tune=zerolatency speed-preset=ultrafast key-int-max=15 ! rtph264pay name=pay0 pt=96 config-interval=1"
PICTURES = "jpegenc ! rtpjpegpay name=pay0 pt=26"


def main() -> None:
    """Serve until the process is ended."""
    Gst.init(None)
    server = GstRtspServer.RTSPServer()
    server.set_address("127.0.0.1")
    server.set_service(sys.argv[1])
    role = None
    if len(sys.argv) > 2:
        role = GstRtspServer.RTSPToken()
        role.set_string("media.factory.role", "viewer")
        auth = GstRtspServer.RTSPAuth()
        auth.add_basic(GstRtspServer.RTSPAuth.make_basic(*sys.argv[2].split(":")), role)
        server.set_auth(auth)
    for path, size, coding in (
        ("camera", (320, 240), H264),
        ("small", (160, 120), H264),
        ("motion", (320, 240), PICTURES),
    ):
        factory = GstRtspServer.RTSPMediaFactory()
        factory.set_launch(f"( {CAMERA.format(*size)}{coding} )")
        factory.set_shared(True)
        if role is not None:
            factory.add_role_from_structure(
                Gst.Structure.new_from_string(
                    "viewer, media.factory.access=(boolean)true, media.factory.construct=(boolean)true;"
                )
            )
        server.get_mount_points().add_factory(f"/{path}", factory)
    server.attach(None)
    sys.stdout.write("serving\n")
    sys.stdout.flush()
    GLib.MainLoop().run()


if __name__ == "__main__":
    main()
