"""Exceptions of the core. Each message names the event, the observed value and the remedy.

CoreError
├── InvalidInput (also ValueError)      argument of wrong shape, dtype or value: a caller bug
├── InvalidSetting (UserError, also ValueError)   an option chosen by the user is out of range
├── NativeLibraryMissing (UserError)    the C++ core was not built or cannot be loaded
├── BundleError (UserError)             a model file cannot be used
│   ├── BundleCorrupt                   wrong digest, truncated, or non-finite values
│   └── UnknownFormatVersion            written by a later version
├── ExportError (UserError)             a model cannot be written in a foreign format
└── RecordingError (UserError)          a recording cannot be used
    ├── RecordingMissing                a file or folder does not exist
    └── RecordingInvalid                wrong counts, sizes, polarity, calibration or video data

`UserError` marks failures that the user of a program can remedy (a file, an option, a disk, a
device). It is the base of such errors in every package of the project. Programs report it as one
sentence. Any other exception that ends a program is a bug in the program.
"""


class UserError(Exception):
    """Failure that the user of a program can remedy; its text is shown to them as one sentence."""


class CoreError(Exception):
    """Base class of all exceptions that `gsplat_core` raises deliberately."""


class InvalidInput(CoreError, ValueError):
    """Argument of a wrong shape, type or value: a bug in the calling program, not a user error."""


class InvalidSetting(CoreError, UserError, ValueError):
    """User-chosen option (a number of steps, a scale, a name) out of its range."""


class NativeLibraryMissing(CoreError, UserError):
    """The C++ core was not built or cannot be loaded."""


class BundleError(CoreError, UserError):
    """A model file cannot be used."""


class BundleCorrupt(BundleError):
    """A model file has a wrong digest, is truncated or contains non-finite values."""


class UnknownFormatVersion(BundleError):
    """A model file was written by a later version."""


class ExportError(CoreError, UserError):
    """A model cannot be represented in a foreign file format."""


class RecordingError(CoreError, UserError):
    """A recording cannot be used."""


class RecordingMissing(RecordingError):
    """A file or folder of a recording does not exist."""


class RecordingInvalid(RecordingError):
    """A recording has wrong counts or sizes of files, or wrong mask polarity, calibration or video data."""
