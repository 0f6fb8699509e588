"""Where things are computed: no copies between torch and Dr.Jit, networks on a GPU, and what happens without one."""

import subprocess
import sys

import drjit as dr
import pytest
import torch
from helpers.quick_fits import QUICK, distance
from torch.nn import functional as F

import mi_ring
from mi_ring import fit
from mi_ring.errors import InputError
from mi_ring.fitting.losses import mask_loss, rgb_loss, velocity_loss
from mi_ring.fitting.optimisation import network_steppers
from mi_ring.nets.brdf_net import BRDFNet
from mi_ring.nets.shape_net import ShapeNet
from mi_ring.rendering import bridge
from mi_ring.system import machine

TINY = ["--iterations", "1", "--levels", "2", "--widths", "28", "--shares", "1", "--batch", "2", "--subdivisions", "2",
        "--domain", "sphere", "--refine", "none", "--no-indirect", "--detail", "none"]  # fmt: skip
needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU and a torch built with CUDA")


def test_seam_copies_nothing():
    tensor = torch.arange(15.0, device=machine.device()).reshape(5, 3)
    array = bridge.to_drjit(tensor)
    assert bridge.to_torch(array).data_ptr() == tensor.data_ptr()
    assert bridge.to_torch(array).tolist() == tensor.flatten().tolist()
    doubled = 2 * array
    dr.eval(doubled)
    one, other = bridge.to_torch(doubled), bridge.to_torch(doubled)
    assert one.data_ptr() == other.data_ptr() and one.tolist() == (2 * tensor.flatten()).tolist()


def test_networks_and_losses_stay_on_the_device_of_their_input():
    """On the device that knows shapes but no numbers: torch refuses to mix it with the processor as it would a GPU."""
    with torch.device("meta"):
        net, brdf_net, s = ShapeNet(steps=3), BRDFNet(), torch.empty(35, 3)
        images, masks = (torch.empty(2, 5, 7, *more, requires_grad=True) for more in ((3,), ()))
    x, material = net(s), brdf_net(s)
    terms = [
        velocity_loss(net.velocity, x, 0.01),
        rgb_loss(images, torch.empty_like(images), torch.empty_like(images, dtype=torch.bool), 1.0, "l1+log"),
        mask_loss(masks, torch.empty_like(masks), 1.5),
    ]
    assert all(t.is_meta for t in (x, *material.values(), *terms))
    (x.sum() + sum(m.sum() for m in material.values()) + sum(terms)).backward()
    assert all(p.grad.is_meta for p in (*net.parameters(), *brdf_net.parameters(), images, masks))


@pytest.mark.parametrize(
    "amx, bf16, name, told, expected",
    [
        (True, True, "Intel Xeon", None, True), (True, True, "Intel Xeon", "AVX512_CORE", False),
        (True, True, "a system without its registers", None, False),
        (True, True, "Intel Xeon", "avx512_core_amx", True), (False, True, "Intel Xeon", None, False),
        (False, True, "AMD EPYC", None, True), (False, False, "AMD EPYC", None, False),
        (False, True, "AMD EPYC", "AVX512_CORE", False), (False, True, "AMD EPYC", "AVX512_CORE_BF16", True),
    ],
)  # fmt: skip
def test_bfloat16_is_for_processors_that_are_faster_with_it(amx, bf16, name, told, expected, monkeypatch):
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "AVX512")
    monkeypatch.setattr(torch.cpu, "_is_amx_tile_supported", lambda: amx)
    monkeypatch.setattr(torch.cpu, "_init_amx", lambda: name != "a system without its registers")
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: bf16)
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"cpu_name": name}, raising=False)
    if told:
        monkeypatch.setenv("ONEDNN_MAX_CPU_ISA", told)
    else:
        monkeypatch.delenv("ONEDNN_MAX_CPU_ISA", raising=False)
    for precision, used in (("auto", expected), ("bfloat16", True), ("float32", False)):
        with machine.autocast(precision, torch.device("cpu"))():
            assert torch.is_autocast_enabled("cpu") == used
        # Muon never where the processor is slower with it.
        networks = mi_ring.FittedObject(torch.zeros(3), 1.0)
        _, muon = network_steppers(networks, mi_ring.Config(precision=precision), torch.device("cpu"))
        assert muon.optimizer.dtype == (torch.bfloat16 if expected and precision != "float32" else torch.float32)


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without GPU")
def test_without_a_gpu_the_fit_says_so_and_goes_on(small_capture, tmp_path, capsys):
    assert fit.main([str(small_capture), "--out", str(tmp_path / "run"), "--variant", "cuda_ad_rgb", *TINY]) == 0
    said = capsys.readouterr().out
    assert "--variant cuda_ad_rgb: no usable GPU (" in said and "using llvm_ad_rgb on the processor" in said
    assert '"variant": "llvm_ad_rgb"' in (tmp_path / "run" / "config.json").read_text()


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without GPU")
def test_without_a_working_gpu_driver_the_fit_goes_on(monkeypatch, capsys):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(dr, "has_backend", lambda backend: False)
    assert machine.set_variant("cuda_ad_rgb") == "llvm_ad_rgb"
    assert "(Dr.Jit finds none, or its driver is too old)" in capsys.readouterr().out


def test_fit_switches_to_the_variant_asked_for(small_capture, tmp_path):
    program = (
        "import sys, mitsuba as mi; from mi_ring import fit; mi.set_variant('scalar_rgb');"
        "status = fit.main(sys.argv[1:]); assert mi.variant() == 'llvm_ad_rgb'; sys.exit(status)"
    )
    command = [sys.executable, "-c", program, str(small_capture), "--out", str(tmp_path / "run"), *TINY]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_determinism_is_refused_on_a_gpu():
    with pytest.raises(InputError, match="--deterministic: needs --variant llvm_ad_rgb"):
        fit.parse_options(["scene.xml", "--deterministic", "--variant", "cuda_ad_rgb"])


@needs_gpu
def test_flow_on_a_gpu_is_that_of_the_processor():
    torch.manual_seed(3)
    net, s = ShapeNet(steps=3), F.normalize(torch.randn(300, 3), dim=1)
    net.output.weight.data.mul_(100)  # it starts at almost 0
    expected = net(s)
    expected.square().sum().backward()
    gradients = [p.grad.clone() for p in net.parameters()]
    net.zero_grad()
    x = net.cuda()(s.cuda())
    x.square().sum().backward()
    assert torch.allclose(x.cpu(), expected, atol=1e-5)
    for p, g in zip(net.parameters(), gradients):
        assert torch.allclose(p.grad.cpu(), g, rtol=1e-3, atol=1e-4)


@needs_gpu
def test_fit_on_a_gpu_finds_the_ellipsoid(small_capture, tmp_path):
    command = [sys.executable, "-m", "mi_ring.fit", str(small_capture), "--out", str(tmp_path / "run"),
               "--variant", "cuda_ad_rgb", "--iterations", "90", *QUICK]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0 and "no GPU" not in done.stdout, done.stderr
    assert '"variant": "cuda_ad_rgb"' in (tmp_path / "run" / "config.json").read_text()
    assert distance(tmp_path / "run" / "mesh.ply") < 0.04
