"""Errors of the core. Each says what happened, the value that was seen, and what to do.

CoreError
├── InvalidInput (also ValueError)      an argument has a wrong shape, type or value
├── NativeLibraryMissing                the C++ core was not built or cannot be loaded
├── BundleError                         a model file cannot be used
│   ├── BundleCorrupt                   wrong digest, truncated, not finite
│   └── UnknownFormatVersion            written by a later version
└── RecordingError                      a recording cannot be used
    ├── RecordingMissing                a file or folder is not there
    └── RecordingInvalid                counts, sizes, polarity, calibration or video data are wrong
"""


class CoreError(Exception):
    """Base of everything the core raises on purpose."""


class InvalidInput(CoreError, ValueError):
    """An argument has a wrong shape, type or value."""


class NativeLibraryMissing(CoreError):
    """The C++ core was not built or cannot be loaded."""


class BundleError(CoreError):
    """A model file cannot be used."""


class BundleCorrupt(BundleError):
    """A model file has a wrong digest, is truncated or holds values that are not finite."""


class UnknownFormatVersion(BundleError):
    """A model file was written by a later version."""


class RecordingError(CoreError):
    """A recording cannot be used."""


class RecordingMissing(RecordingError):
    """A file or folder of a recording is not there."""


class RecordingInvalid(RecordingError):
    """Counts, sizes, polarity, calibration or video data of a recording are wrong."""
