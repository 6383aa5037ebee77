"""Op `render_frame`: a whole frame on CUDA, from raw Gaussians to the image, in a few launches."""
