"""Measures of a reconstruction, each next to the trivial baselines that it has to beat. `docs/offline.md` defines them.

* `baselines`: copies and means of frames, and optical flow.
* `protocols`: the held-out, causal and retention protocols on rendered pictures.
* `geometry`: accuracy in three dimensions, from `depth`, `motion` and `views`.
* `views`: further cameras and the right eye.
* `scores`: sums of fixed size that the protocols share, and the picture on the screen when the next frame arrived.

Each protocol takes frames one at a time, keeps sums of fixed size and passes every frame's figures to a callback.
"""
