"""Streaming operators that handle faults of real endoscopic video: one stage per fault, run in
sequence.
"""
