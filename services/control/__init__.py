"""HTTP control plane of the service. Imports neither torch nor OpenCV; the heavy work runs in other
processes."""

from services.control.app import new_app
from services.control.parts import Parts

__all__ = ["Parts", "new_app"]
