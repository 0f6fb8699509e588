"""The machine and the operating system: LLVM, threads, GPUs, files, the cache, progress bars, the command line.

May import: mitsuba, drjit, torch, numpy, tqdm, tyro, filelock, platformdirs.
"""
