"""Registries: named things of one sort (subtasks, tasks, robots, packs, ...), open to plugins."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Generic, TypeVar, cast

from mjhab.core.errors import fault, unknown_name, wrong_type, wrong_value
from mjhab.core.names import check_name
from mjhab.core.registration import plugins

Item = TypeVar("Item")


class Registry(Generic[Item]):
    """Items by name, in the order in which they were registered; those of mjhab itself come first.

    Args:
        what: what an item is, for messages: "subtask".
        builtin: name to reference (``"package.module:NAME"``) of mjhab's own items. A module is imported when its item
            is looked up first, so that names are known without any import.
    """

    def __init__(self, what: str, builtin: Mapping[str, str] | None = None) -> None:
        self._what = what
        self._references = dict(builtin or {})
        self._names = dict.fromkeys(self._references, "")
        self._items: dict[str, Item] = {}
        self.version = 0
        """Changes with every registration: what is derived from all items is kept under it."""

    def add(self, name: str, item: Item) -> Item:
        """Register an item and return it. One that a plugin adds is taken back if the plugin raises later on.

        Raises:
            UsageError: the name is taken; the message says by whom. Or it is no name, see `check_name`.
        """
        check_name(f"name of the {self._what}", name)
        source = plugins.current_source()
        # Replacing silently would make results depend on the order of imports.
        if name in self._names:
            raise wrong_value(
                self._what,
                name,
                f"registered once: {self._owner(name)} and {_who(source)} do it",
                "Give one of them another name.",
            )
        self._items[name] = item
        self._names[name] = source
        self.version += 1
        plugins.note_registration(f"{self._what} {name!r}", lambda: self.remove(name))
        return item

    def _owner(self, name: str) -> str:
        """Who has registered a name."""
        return "mjhab itself" if name in self._references else _who(self._names[name])

    def remove(self, name: str) -> None:
        """Take back a registration. Items of mjhab itself stay.

        Raises:
            UsageError: nobody has registered the name.
        """
        if name not in self._names or name in self._references:
            raise fault(self._what, f"{name!r} has not been registered by a plugin.")
        del self._items[name]
        del self._names[name]
        self.version += 1

    def __getitem__(self, name: str) -> Item:
        """The item of a name.

        Raises:
            UsageError: there is none, see `check`.
        """
        self.check(name)
        if name not in self._items:
            # On first use: the built-in ones import their code only when they are asked for.
            self._items[name] = cast(Item, plugins.referred(self._references[name]))
        return self._items[name]

    def check(self, name: str) -> str:
        """Return a name that is registered.

        Raises:
            UsageError: it is not; the message lists the names, and the plugins that could not be loaded.
        """
        # Callers from outside of the type checker give anything, lists too.
        if not isinstance(name, str) or name not in self._names:
            advice = plugins.failed_plugins()
            raise unknown_name(self._what, name, self._names, advice=advice)
        return name

    def __contains__(self, name: object) -> bool:
        return name in self._names

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def names(self) -> tuple[str, ...]:
        """Names of all items."""
        return tuple(self._names)

    def values(self) -> tuple[Item, ...]:
        """All items in the order of `names`."""
        return tuple(self[name] for name in self._names)

    def is_builtin(self, name: str) -> bool:
        """Whether an item is one of mjhab itself."""
        return name in self._references

    def described(self, name: str) -> str:
        """An item in words for messages, with the plugin that registered it: "subtask 'push' of plugin 'push.py'"."""
        source = self._names.get(name, "")
        return (
            f"{self._what} {name!r} of plugin {source!r}"
            if source
            else f"{self._what} {name!r}"
        )

    def source(self, name: str) -> str:
        """Name of the plugin that registered an item, "" for mjhab itself and for code outside of plugins."""
        return self._names[name]


def check_item(function: str, item: object, kind: type) -> None:
    """Check what a registering function was given.

    Args:
        function: its name, such as "register_subtask".
        item: what it was given.
        kind: what it expects.

    Raises:
        UsageError: the item is of another kind.
    """
    if isinstance(item, kind):
        return
    raise wrong_type(
        "argument",
        item,
        f"a {kind.__name__}",
        f"Make one first: mjhab.{function}({kind.__name__}(...)).",
        f"mjhab.{function}",
    )


def _who(source: str) -> str:
    return f"plugin {source!r}" if source else "the calling program"
