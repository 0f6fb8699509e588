"""Networks by name: `ring.pt` stores names of networks instead of pickled classes."""

from collections.abc import Callable
from importlib.metadata import entry_points
from typing import Any

from torch import nn

from mi_ring.errors import InputError

GROUP = "mi_ring.networks"  #: entry points by which other packages offer networks

_networks: dict[str, type[nn.Module]] = {}


def register_network(name: str) -> Callable[[type[nn.Module]], type[nn.Module]]:
    """A decorator that registers a class of networks under the `name` by which `ring.pt` refers to it.

    The class may have a method `arguments`, which returns the arguments of its constructor as a dictionary of plain
    data. Weights are saved by `state_dict`. Networks of other packages are found without an import if they are entry
    points of the group `mi_ring.networks`. Raises ValueError if another class has the name.
    """

    def register(network: type[nn.Module]) -> type[nn.Module]:
        known = _networks.get(name)
        if known is not None and qualified_name(known) != qualified_name(network):
            raise ValueError(f"network {name}: is registered already, as {known.__module__}.{known.__qualname__}")
        _networks[name] = network
        return network

    return register


def qualified_name(network: type) -> tuple[str, str]:
    """Module and name of a class. They are equal if a notebook cell defines the class again."""
    return network.__module__, network.__qualname__


def architecture_of(network: nn.Module) -> dict:
    """The registered name and the arguments of a network, for `build`. Raises ValueError if it is not registered."""
    for name, known in _networks.items():
        if qualified_name(type(network)) == qualified_name(known):
            arguments = getattr(network, "arguments", None)
            return {"name": name, "arguments": arguments() if arguments else {}}
    raise ValueError(f'{type(network).__name__}: is not registered, so it cannot be saved; put '
                     '@mi_ring.register_network("…") above the class')  # fmt: skip


def build(architecture: dict) -> Any:
    """A network of an architecture, with random weights. Raises InputError if its name is not registered."""
    name = architecture["name"]
    for entry in entry_points(group=GROUP, name=name) if name not in _networks else ():
        register_network(name)(entry.load())
    if name not in _networks:
        raise InputError(f'networks: was fitted with "{name}", which is not registered here (known: '
                         f"{', '.join(sorted(_networks))}); import the module that registers it first")  # fmt: skip
    return _networks[name](**architecture["arguments"])
