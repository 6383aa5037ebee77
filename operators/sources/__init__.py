"""Where frames come from: recordings now, streams of every kind behind the same protocol."""
