"""Recordings of live sessions: what came in, what was done with it, what was shown. docs/design/sessions.md describes the files."""

from gsplat_core.io.sessions.reader import SessionReader, is_session
from gsplat_core.io.sessions.records import SessionInfo
from gsplat_core.io.sessions.writer import SessionWriter, WriterOptions

__all__ = ["SessionInfo", "SessionReader", "SessionWriter", "WriterOptions", "is_session"]
