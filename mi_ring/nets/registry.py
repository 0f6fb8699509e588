"""Networks by name: what `ring.pt` says instead of pickling classes."""

from collections.abc import Callable
from importlib.metadata import entry_points
from typing import Any

from torch import nn

from mi_ring.errors import InputError

GROUP = "mi_ring.networks"  #: entry points of packages that bring networks along

_networks: dict[str, type[nn.Module]] = {}


def register_network(name: str) -> Callable[[type[nn.Module]], type[nn.Module]]:
    """A decorator that gives a class of networks the `name` by which `ring.pt` refers to it.

    `network(**arguments)` must make it anew, where `arguments` is the dictionary of plain data that its method of that
    name returns; without such a method there are none. Its weights are those of its `state_dict`. A package can have
    its networks found without being imported: by entry points of the group `mi_ring.networks`.

    Raises ValueError if another class has the name.
    """

    def register(network: type[nn.Module]) -> type[nn.Module]:
        known = _networks.get(name)
        if known is not None and names_of(known) != names_of(network):
            raise ValueError(f"network {name}: is registered already, as {known.__module__}.{known.__qualname__}")
        _networks[name] = network
        return network

    return register


def names_of(network: type) -> tuple[str, str]:
    """What tells one class from another that was defined anew."""
    return network.__module__, network.__qualname__


def architecture_of(network: nn.Module) -> dict:
    """What makes a network anew: its registered name and its arguments. Raises ValueError if it is not registered."""
    for name, known in _networks.items():
        if names_of(type(network)) == names_of(known):  # a cell of a notebook may have defined it once more
            arguments = getattr(network, "arguments", None)
            return {"name": name, "arguments": arguments() if arguments else {}}
    raise ValueError(f'{type(network).__name__}: has no name to be saved by; put @mi_ring.register_network("…") above '
                     "the class")  # fmt: skip


def build(architecture: dict) -> Any:
    """A network of this architecture, with random weights. Raises InputError if its name is not registered."""
    name = architecture["name"]
    if name not in _networks:
        for entry in entry_points(group=GROUP, name=name):
            register_network(name)(entry.load())
    if name not in _networks:
        raise InputError(f'networks: was fitted with "{name}", which is not registered here (known: '
                         f"{', '.join(sorted(_networks))}); import the module that registers it first")  # fmt: skip
    return _networks[name](**architecture["arguments"])
