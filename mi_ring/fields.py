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
    """What mi_ring does with each field of a file format: it uses, refuses, reports or ignores it.

    A key holds one or more names, separated by spaces; `*` in a name stands for any text. The name of a nested field
    begins with that of its parent: see `json_names` and `xml_names`. A name that ends in `/*` includes all nested
    fields.
    """

    used: Mapping[str, str]
    refused: Mapping[str, str] = field(default_factory=dict)  #: unless they are 0, empty or as usual
    told: Mapping[str, str] = field(default_factory=dict)  #: not used, and `convert` says so
    harmless: Mapping[str, str] = field(default_factory=dict)  #: not used, because they change nothing

    def rows(self) -> Iterator[tuple[str, str, str]]:
        """Yield all entries as (names, kind, text).

        The text is the meaning of a used field, otherwise the reason why the field is not used.
        """
        for kind in KINDS:
            for names, why in getattr(self, kind).items():
                yield names, kind, why

    def names(self) -> list[str]:
        """List the names of all fields."""
        return [name for names, _, _ in self.rows() for name in names.split()]

    @cached_property
    def patterns(self) -> list[tuple[re.Pattern[str], str, str]]:
        """All entries as (compiled regular expression of the names, kind, text); see `rows`."""
        return [(re.compile("|".join(translate(name.removesuffix("/*")) for name in names.split())), kind, why)
                for names, kind, why in self.rows()]  # fmt: skip

    def kind_of(self, name: str) -> tuple[str, str]:
        """Return (kind, meaning or reason) of a field; ("unknown", "unknown") if the format has no such field."""
        found = ((kind, why) for pattern, kind, why in self.patterns if pattern.match(name))
        return next(found, ("unknown", "unknown"))

    @cached_property
    def closed(self) -> set[str]:
        """Names of fields whose nested fields are not listed, because the same text holds for all of them."""
        return {name.removesuffix("/*") for name in self.names() if name.endswith("/*")}

    def unused(self, names: Iterable[str]) -> dict[str, str]:
        """Return the fields among `names` that the user must be told about: reason by name, or "unknown".

        Each name once.
        """
        kinds = {name: self.kind_of(name) for name in dict.fromkeys(names)}
        return {name: why for name, (kind, why) in kinds.items() if kind in ("told", "unknown")}


def json_names(value: Any, closed: set[str], parent: str = "") -> Iterator[str]:
    """Yield the names of all fields in a JSON value, as parent/name. Lists add no level to a name.

    Fields nested in those of `closed` are left out.
    """
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
    """Yield the names of all nested elements, as parent/name, and of attributes, as element@name, in an XML element.

    A `property` is named property:name. Elements nested in those of `closed` are left out.
    """
    yield from (f"{element.tag}@{key}" for key in element.attrib)
    for child in element:
        if child.tag == "property":
            yield f"{element.tag}/property:{child.get('name')}"
        else:
            yield (name := f"{element.tag}/{child.tag}")
            if name not in closed:
                yield from xml_names(child, closed)
