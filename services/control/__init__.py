"""The control plane: the service's HTTP API. It imports no torch and no OpenCV; what it steers are processes and stores of their own."""

from services.control.app import new_app
from services.control.parts import Parts

__all__ = ["Parts", "new_app"]
