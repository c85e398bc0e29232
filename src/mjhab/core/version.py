"""The version of mjhab; its one owner."""

__version__ = "0.1.0"
