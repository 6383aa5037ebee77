"""Interactive model viewer in a browser, by viser (extra `viser`)."""
