"""Language: the same request in other words, politely, or mistyped."""

from __future__ import annotations

import re

import numpy as np

from mjhab.config.perturbing import Drawn, Perturbation, Quantity

POLITE = (
    "please {0}",
    "could you {0}",
    "would you kindly {0}",
    "can you {0} for me",
    "{0}, please",
    "{0}, thank you",
)
PARAPHRASES = (
    "go ahead and {0}",
    "make sure to {0}",
    "try to {0}",
    "get going and {0}",
    "your turn to help, {0}",
    "now {0}",
)
"""Imperatives around an imperative, so that polite forms fit around them."""
VERBS: dict[str, tuple[str, ...]] = {
    "pick up": ("grab", "lift", "get hold of"),
    "take": ("get", "grab", "pick up"),
    "grab": ("take hold of", "pick up", "seize"),
    "put": ("place", "leave"),
    "place": ("put", "leave"),
    "set": ("put",),
    "set the table": ("lay the table",),
    "lay the table": ("set the table",),
    "put the groceries away": ("store the groceries",),
    "prepare the groceries": ("get the groceries ready",),
    "sort": ("arrange",),
    "tidy": ("clean",),
    "tidy up": ("clean up", "straighten up"),
    "clean up": ("tidy up",),
    "open": ("pull open", "open up"),
    "close": ("shut", "push shut"),
    "push": ("press",),
    "pull": ("draw",),
    "go to": ("head to", "travel to", "go over to"),
    "drive to": ("roll to", "head to", "make your way to"),
    "move to": ("head to", "go over to"),
    "move": ("bring", "shift"),
    "carry": ("transport", "bring"),
    "bring": ("carry", "transport"),
}
"""What an instruction or a part of it begins with, and what means the same."""
WORDS: dict[str, tuple[str, ...]] = {
    "fridge": ("refrigerator",),
    "couch": ("sofa",),
    "sofa": ("couch",),
    "TV": ("television",),
    "counter": ("worktop",),
    "cupboard": ("cabinet",),
    "can": ("tin",),
    "box": ("carton",),
    "top": ("upper",),
    "bottom": ("lower",),
    "nearest to": ("closest to",),
    "next to": ("beside",),
}
"""Other words, wherever they are."""
_BEGINNING = r"(?:^|(?<=, then )|(?<=: ))"
_NEIGHBOURS = dict(
    zip("abcdefghijklmnopqrstuvwxyz", "svxsrdhgokjknbpowtdyibecux", strict=True)
)
"""A key beside each key."""
_SHORTEST = 4
"""Letters of the shortest word that is mistyped."""


class LanguageAxis(Perturbation):
    """Every level does what the one below does, and more: politeness, a synonym, a paraphrase, typing errors."""

    name = "language"
    about = "politeness, synonyms, paraphrases and typing errors of instructions"
    quantities = {  # noqa: RUF012
        "polite": Quantity("", (1, 1, 1, 1, 1), "polite forms"),
        "synonyms": Quantity("", (0, 1, 2, 2, 3), "most words that are replaced"),
        "paraphrases": Quantity(
            "", (0, 0, 1, 1, 1), "turns of phrase around the request"
        ),
        "typos": Quantity("", (0, 0, 0, 1, 3), "typing errors"),
    }
    on_device = True

    def sentence(self, drawn: Drawn, text: str, number: int) -> str:
        """The sentence in other words."""
        # An episode without a sentence has none in other words either.
        if not text:
            return text
        # By the place of the sentence: equal ones of an episode may differ, and none depends on the others.
        random = drawn.stream(number)
        amounts = drawn.amounts
        for _ in range(int(amounts["synonyms"])):
            text = with_synonym(text, random)
        for _ in range(int(amounts["paraphrases"])):
            text = _one(PARAPHRASES, random).format(text)
        for _ in range(int(amounts["polite"])):
            text = _one(POLITE, random).format(text)
        for _ in range(int(amounts["typos"])):
            text = with_typo(text, random)
        return text


def _one(choices: tuple[str, ...], random: np.random.Generator) -> str:
    return choices[int(random.integers(len(choices)))]


def with_synonym(text: str, random: np.random.Generator) -> str:
    """The text with one word or turn of `VERBS` or `WORDS` replaced, where there is one."""
    longest: dict[int, tuple[int, tuple[str, ...]]] = {}
    for words, before in ((VERBS, _BEGINNING), (WORDS, "")):
        for word, others in words.items():
            for match in re.finditer(rf"{before}\b{re.escape(word)}\b", text):
                end, _ = longest.get(match.start(), (0, ()))
                # The longest one that begins there: "set the table" before "set".
                if match.end() > end:
                    longest[match.start()] = (match.end(), others)
    if not longest:
        return text
    # Sorted, so that the draw does not depend on the order of the tables.
    start = sorted(longest)[int(random.integers(len(longest)))]
    end, others = longest[start]
    return f"{text[:start]}{_one(others, random)}{text[end:]}"


def with_typo(text: str, random: np.random.Generator) -> str:
    """The text with one typing error inside of a word: letters swapped, one left out, doubled, or its neighbour hit."""
    words = [
        match for match in re.finditer(r"[A-Za-z]+", text) if len(match[0]) >= _SHORTEST
    ]
    if not words:
        return text
    match = words[int(random.integers(len(words)))]
    # Neither the first nor the last letter: those are what readers look at.
    at = match.start() + 1 + int(random.integers(len(match[0]) - 2))
    kind = int(random.integers(4))
    letter = text[at]
    swapped = text[at + 1] + letter
    if kind == 0:
        return f"{text[:at]}{swapped}{text[at + 2 :]}"
    middle = ("", letter + letter, _NEIGHBOURS.get(letter, letter))[kind - 1]
    return f"{text[:at]}{middle}{text[at + 1 :]}"


LANGUAGE = LanguageAxis()
