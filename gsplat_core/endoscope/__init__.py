"""Preprocessing of endoscopic video: field of view, highlights, tools, artefacts, scene changes and pictures from outside the body.

Most of it is picture analysis with numpy and OpenCV at reduced size. Tools are also segmented by neural networks.
"""
