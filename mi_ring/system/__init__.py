"""The machine that all runs on: LLVM, threads, whole files, the command line.

May import: mitsuba, drjit, torch, tqdm, tyro, filelock.
"""
