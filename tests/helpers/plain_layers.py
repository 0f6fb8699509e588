"""Networks by torch's own layers."""

from torch.nn import functional as F

from mi_ring.nets import mlp


def plain(net, x):
    """An MLP, by torch's own layers."""
    h = net.encoding(x)
    for layer in net.hidden:
        h = F.leaky_relu(layer(h), mlp.SLOPE)
    return net.output(h)
