"""The machine and the operating system: LLVM, threads, GPUs, files, progress bars, the command line.

May import: mitsuba, drjit, torch, tqdm, tyro, filelock.
"""
