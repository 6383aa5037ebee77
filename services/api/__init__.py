"""HTTP control plane of the service. Imports neither torch nor OpenCV; the heavy work runs in other processes."""

from services.api.app import new_app
from services.api.state import Parts

__all__ = ["Parts", "new_app"]
