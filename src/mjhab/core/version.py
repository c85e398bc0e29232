"""The version of mjhab; its one owner."""

__version__ = "0.2.0"
