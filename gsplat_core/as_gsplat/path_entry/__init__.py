"""Folder on `sys.path` of programs that run under `python -m gsplat_core.as_gsplat`.

Processes that `multiprocessing` spawns inherit `sys.path`, but not import hooks. The modules here install the hook in such a
process when a program imports gsplat.
"""
