"""How episodes come to be recorded: the recorder, generation by several workers, replay."""
