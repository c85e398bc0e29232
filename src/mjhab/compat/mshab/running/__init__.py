"""Running scripts that import ``mshab`` and ``mani_skill``: what is answered by which of our modules."""
