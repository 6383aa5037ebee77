"""Sources of frames: recordings and live streams behind one protocol."""
