"""Dialects: which keys a request and its answer have. All of them are msgpack over websockets, see `serving.packing`.

In all of them a server greets with a map of metadata, and tells of an error in a text.
"""
