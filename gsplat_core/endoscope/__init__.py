"""Preprocessing of endoscopic video by picture analysis with numpy and OpenCV at reduced size."""
