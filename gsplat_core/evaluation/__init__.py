"""How good a reconstruction is, by the protocols that its figures are compared under; one module a protocol.

* `baselines`: what doing nothing scores; stands beside every other figure.
* `heldout`: the field's split, rendered from a finished model.
* `causal`: predict the next frame, then learn from it.
* `live`: what was on the screen when the next frame arrived.
* `geometry`: how true a model is in three dimensions: `depth_share`, `normals`, `novel_view`, `tracking`, `trajectory`, `parts`.
* `second_eye`: the right eye's view beside what the right eye saw.
* `retention`: what a model still knows of earlier frames and of places that it saw before.

Each takes frames one at a time, keeps sums of fixed size and hands every frame's figures to a callback. `docs/evaluation.md` defines them.
"""
