"""Describes how mi_ring treats each field of a file format: it uses, refuses, reports or ignores the field."""

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
    """The fields of a file format in four groups: mi_ring uses, refuses, reports or ignores them.

    Each group is a dictionary of texts by field names. The text is the meaning of a used field; for the other groups it
    is the reason why the field is not used. A key contains one or more names, separated by spaces. In a name, `*`
    stands for any text. The name of a nested field begins with the name of its parent: see `json_names` and
    `xml_names`. A name that ends in `/*` includes all nested fields.
    """

    used: Mapping[str, str]
    refused: Mapping[str, str] = field(default_factory=dict)  #: unless they are 0, empty or as usual
    told: Mapping[str, str] = field(default_factory=dict)  #: not used, and `convert` says so
    harmless: Mapping[str, str] = field(default_factory=dict)  #: not used, because they change nothing

    def rows(self) -> Iterator[tuple[str, str, str]]:
        """Yield all entries as (names, group, text). The group is one of `KINDS`."""
        for kind in KINDS:
            for names, why in getattr(self, kind).items():
                yield names, kind, why

    def names(self) -> list[str]:
        """List the names of all fields in all groups."""
        return [name for names, _, _ in self.rows() for name in names.split()]

    @cached_property
    def patterns(self) -> list[tuple[re.Pattern[str], str, str]]:
        """All `rows` as (regular expression that matches the names, group, text)."""
        return [(re.compile("|".join(translate(name.removesuffix("/*")) for name in names.split())), kind, why)
                for names, kind, why in self.rows()]  # fmt: skip

    def kind_of(self, name: str) -> tuple[str, str]:
        """Return (group, text) of the field `name`; ("unknown", "unknown") if no group contains the field."""
        found = ((kind, why) for pattern, kind, why in self.patterns if pattern.match(name))
        return next(found, ("unknown", "unknown"))

    @cached_property
    def closed(self) -> set[str]:
        """Names of the fields that include all nested fields; these are not listed one by one."""
        return {name.removesuffix("/*") for name in self.names() if name.endswith("/*")}

    def unused(self, names: Iterable[str]) -> dict[str, str]:
        """Find fields that the user must be told about: fields of the group `told`, and unknown fields.

        `names`: the fields of a file. Returns by name the reason why the field is not used, or "unknown".
        """
        kinds = {name: self.kind_of(name) for name in dict.fromkeys(names)}
        return {name: why for name, (kind, why) in kinds.items() if kind in ("told", "unknown")}


def json_names(value: Any, closed: set[str], parent: str = "") -> Iterator[str]:
    """Yield the names of all fields in a JSON value. A nested field is named parent/name; lists add no level.

    `closed`: names of fields whose nested fields are skipped. `parent`: the first part of all names, with its slash.
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
    """Yield the names of the fields in an XML element: attributes and nested elements.

    An attribute is named element@name, a nested element parent/name. An element `property` is named
    parent/property:name. `closed`: names of elements whose content is skipped.
    """
    yield from (f"{element.tag}@{key}" for key in element.attrib)
    for child in element:
        if child.tag == "property":
            yield f"{element.tag}/property:{child.get('name')}"
        else:
            yield (name := f"{element.tag}/{child.tag}")
            if name not in closed:
                yield from xml_names(child, closed)
