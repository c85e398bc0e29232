"""Language instructions of an episode: `narrator` makes them, `places` names furniture, `apart` tells things apart."""

from mjhab.episodes.narration.narrator import InstructionGenerator

__all__ = ["InstructionGenerator"]
