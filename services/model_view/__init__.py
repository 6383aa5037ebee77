"""A model in a browser, to be turned and played, by viser (extra `viser`)."""
