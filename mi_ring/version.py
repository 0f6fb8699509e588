"""The version of the package, stamped into `ring.pt` and the report."""

__version__ = "0.2.0"
