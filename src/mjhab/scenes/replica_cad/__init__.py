"""ReplicaCAD apartments and YCB objects, read from their published files."""
