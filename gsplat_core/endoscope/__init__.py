"""What the video of a real endoscope does beside showing tissue: found on the picture alone, with numpy and OpenCV, at a reduced size."""
