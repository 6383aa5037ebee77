"""Experimental methods, which do not beat their trivial baseline on all real recordings.

Users select them by name through the registries; no default uses them.
"""
