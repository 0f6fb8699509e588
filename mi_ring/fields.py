"""What an importer does with each field of its format."""

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from fnmatch import translate
from functools import cached_property
from typing import Any
from xml.etree import ElementTree

KINDS = ("used", "refused", "told", "harmless")  #: of fields, as the attributes of `Fields`


@dataclass(frozen=True)
class Fields:
    """The fields of a format: names, and what they mean or why.

    A key holds one or more names, separated by spaces; `*` in a name stands for any text. A nested field has the name
    of its parent before it: see `json_names` and `xml_names`. `/*` at the end: with all that it contains.
    """

    used: Mapping[str, str]
    refused: Mapping[str, str] = field(default_factory=dict)  #: unless they are 0, empty or as usual
    told: Mapping[str, str] = field(default_factory=dict)  #: not used, and `convert` says so
    harmless: Mapping[str, str] = field(default_factory=dict)  #: not used, because they change nothing

    def rows(self) -> Iterator[tuple[str, str, str]]:
        """Each entry as (names, kind, text).

        The text is the meaning of a used field, otherwise the reason why it is not used.
        """
        for kind in KINDS:
            for names, why in getattr(self, kind).items():
                yield names, kind, why

    def names(self) -> list[str]:
        """The names of all fields."""
        return [name for names, _, _ in self.rows() for name in names.split()]

    @cached_property
    def patterns(self) -> list[tuple[re.Pattern[str], str, str]]:
        """What matches the names, kind and meaning or reason of all fields."""
        return [(re.compile("|".join(translate(name.removesuffix("/*")) for name in names.split())), kind, why)
                for names, kind, why in self.rows()]  # fmt: skip

    def kind_of(self, name: str) -> tuple[str, str]:
        """The kind of a field, and its meaning or reason; "unknown" for both if there is none."""
        found = ((kind, why) for pattern, kind, why in self.patterns if pattern.match(name))
        return next(found, ("unknown", "unknown"))

    @cached_property
    def closed(self) -> set[str]:
        """The fields that are not entered, because of all that they contain the same is to be said."""
        return {name.removesuffix("/*") for name in self.names() if name.endswith("/*")}

    def unused(self, names: Iterable[str]) -> dict[str, str]:
        """Those of the names that are told, with the reason, and those that are unknown; each once."""
        kinds = {name: self.kind_of(name) for name in dict.fromkeys(names)}
        return {name: why for name, (kind, why) in kinds.items() if kind in ("told", "unknown")}


def json_names(value: Any, closed: set[str], parent: str = "") -> Iterator[str]:
    """The names of all fields in a JSON value, as parent/name; lists add none. `closed`: not to be entered."""
    if isinstance(value, dict):
        for key, own in value.items():
            yield (name := f"{parent}{key}")
            if name not in closed:
                yield from json_names(own, closed, f"{key}/")
    elif isinstance(value, list):
        for own in value:
            if isinstance(own, dict | list):
                yield from json_names(own, closed, parent)


def xml_names(element: ElementTree.Element, closed: set[str]) -> Iterator[str]:
    """The names of all elements, parent/name, and attributes, element@name, in an XML element, without its own.

    A `property` is named property:name. `closed`: not to be entered.
    """
    yield from (f"{element.tag}@{key}" for key in element.attrib)
    for child in element:
        if child.tag == "property":
            yield f"{element.tag}/property:{child.get('name')}"
        else:
            yield (name := f"{element.tag}/{child.tag}")
            if name not in closed:
                yield from xml_names(child, closed)
