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

    Each group is a dict from field names to a text. For used fields, the text is their meaning. For the other groups,
    it is the reason why they are not used. A key contains one or more names, separated by spaces. In a name, `*` stands
    for any text. A nested field is named parent/name, an XML attribute element@name. A name that ends in `/*` includes
    all nested fields. A field of `refused` causes an error, unless its value is 0, empty or the usual one.
    """

    used: Mapping[str, str]
    refused: Mapping[str, str] = field(default_factory=dict)  #: unless they are 0, empty or as usual
    told: Mapping[str, str] = field(default_factory=dict)  #: not used, and `convert` says so
    harmless: Mapping[str, str] = field(default_factory=dict)  #: not used, because they change nothing

    def rows(self) -> Iterator[tuple[str, str, str]]:
        """Yield all entries as (names, group, text). `names` are separated by spaces.

        The group is "used", "refused", "told" (reported to the user) or "harmless" (ignored).
        """
        for kind in KINDS:
            for names, why in getattr(self, kind).items():
                yield names, kind, why

    def names(self) -> list[str]:
        """List the names of all fields in all groups."""
        return [name for names, _, _ in self.rows() for name in names.split()]

    @cached_property
    def patterns(self) -> list[tuple[re.Pattern[str], str, str]]:
        """List of (regular expression, group, text), one for each entry.

        The expression matches each name of the entry.
        """
        return [(re.compile("|".join(translate(name.removesuffix("/*")) for name in names.split())), kind, why)
                for names, kind, why in self.rows()]  # fmt: skip

    def kind_of(self, name: str) -> tuple[str, str]:
        """Return (group, text) of the field `name`.

        The group is "used", "refused", "told" (reported to the user) or "harmless" (ignored). Group and text are
        "unknown" if no group contains the field.
        """
        found = ((kind, why) for pattern, kind, why in self.patterns if pattern.match(name))
        return next(found, ("unknown", "unknown"))

    @cached_property
    def closed(self) -> set[str]:
        """Names that end in `/*`, without this ending. The nested fields of such a field are not listed one by one."""
        return {name.removesuffix("/*") for name in self.names() if name.endswith("/*")}

    def unused(self, names: Iterable[str]) -> dict[str, str]:
        """Find the fields of a file that are not used and about which the user must be told.

        `names`: names of all fields of the file. Returns a dict from the names of these fields to the reason why each
        is not used. For a field that no group contains, the reason is "unknown".
        """
        kinds = {name: self.kind_of(name) for name in dict.fromkeys(names)}
        return {name: why for name, (kind, why) in kinds.items() if kind in ("told", "unknown")}


def json_names(value: Any, closed: set[str], parent: str = "") -> Iterator[str]:
    """Yield the names of all fields in a JSON value. A nested field is named parent/name; lists add no level.

    `closed`: names of fields whose nested fields are skipped. `parent`: text before all names: the name of the parent
    and a slash; empty for the whole file.
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
