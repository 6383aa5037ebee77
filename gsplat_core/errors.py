"""Errors of the core. Each says what happened, the value that was seen, and what to do.

CoreError
├── InvalidInput (also ValueError)      a call of an API has an argument of a wrong shape, type or value: the caller's mistake
├── InvalidSetting (UserError, also ValueError)   an option that a user chose is out of its range
├── NativeLibraryMissing (UserError)    the C++ core was not built or cannot be loaded
├── BundleError (UserError)             a model file cannot be used
│   ├── BundleCorrupt                   wrong digest, truncated, not finite
│   └── UnknownFormatVersion            written by a later version
├── ExportError (UserError)             a model cannot be written in a format of other programs
└── RecordingError (UserError)          a recording cannot be used
    ├── RecordingMissing                a file or folder is not there
    └── RecordingInvalid                counts, sizes, polarity, calibration or video data are wrong

`UserError` marks, in this package and in those above it, what the user of a program can change: a file, an option, a disk, a device.
A program answers it with one sentence. Every other exception that reaches a program's end is a bug in it.
"""


class UserError(Exception):
    """Something that the user of a program can change; its text is the one sentence that they get."""


class CoreError(Exception):
    """Base of everything the core raises on purpose."""


class InvalidInput(CoreError, ValueError):
    """A call of an API has an argument of a wrong shape, type or value: a mistake of the calling program, not of its user."""


class InvalidSetting(CoreError, UserError, ValueError):
    """An option that a user chose (a number of steps, a scale, a name) is out of its range."""


class NativeLibraryMissing(CoreError, UserError):
    """The C++ core was not built or cannot be loaded."""


class BundleError(CoreError, UserError):
    """A model file cannot be used."""


class BundleCorrupt(BundleError):
    """A model file has a wrong digest, is truncated or holds values that are not finite."""


class UnknownFormatVersion(BundleError):
    """A model file was written by a later version."""


class ExportError(CoreError, UserError):
    """A model cannot be written in a format of other programs."""


class RecordingError(CoreError, UserError):
    """A recording cannot be used."""


class RecordingMissing(RecordingError):
    """A file or folder of a recording is not there."""


class RecordingInvalid(RecordingError):
    """Counts, sizes, polarity, calibration or video data of a recording are wrong."""
