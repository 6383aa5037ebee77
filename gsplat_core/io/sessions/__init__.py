"""Recordings of live sessions: received frames, training schedule and displayed pictures.

docs/design/sessions.md documents the file format.
"""

from gsplat_core.io.sessions.reader import SessionReader, is_session
from gsplat_core.io.sessions.records import SessionInfo
from gsplat_core.io.sessions.writer import SessionWriter, WriterOptions

__all__ = ["SessionInfo", "SessionReader", "SessionWriter", "WriterOptions", "is_session"]
