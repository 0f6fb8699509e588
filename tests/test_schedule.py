"""The schedule of a fit: stages of presets, and of starts near the object."""

import pytest

from mi_ring import fit
from mi_ring.fitting.config import PRESETS, Config
from mi_ring.fitting.schedule import Schedule


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_are_valid_and_can_be_overridden(preset):
    config = fit.parse_options(["scene.xml", "--preset", preset, "--seed", "7"])
    assert config.preset == preset and config.seed == 7
    stages = Schedule.of(config).stages
    assert stages[0].first == 0 and stages[-1].last == config.iterations
    assert all(a.last == b.first for a, b in zip(stages, stages[1:]))
    for name, value in PRESETS[preset].items():
        found = getattr(config, name)
        assert found == value or (name == "weights" and value.items() <= found.items())


def test_starts_near_the_object_spend_less_on_the_coarse_stage():
    def lengths(near):
        return [stage.last - stage.first for stage in Schedule.of(config, near).stages]

    config = Config(iterations=100, shares=(0.5, 0.3, 0.2))
    assert lengths(near=False) == [50, 30, 20]
    assert lengths(near=True) == [17, 43, 20]  # 16.7, and 30 + 0.4 · 33.3
    config = Config(iterations=100, levels=(4,), widths=(128,), shares=(1,))
    assert [s.last for s in Schedule.of(config, near=True).stages] == [100]


def test_paper_preset_is_the_papers():
    config = fit.parse_options(["scene.xml", "--preset", "paper"])
    assert config.weights["mask"] == 0.0 and config.weights["velocity"] == 0.01 and config.loss == "l2"
    assert config.refine == ("none",)
    assert config.optimizer == "adam" and config.learning_rate == 1e-4 and config.decay == 1
    assert config.levels == (5, 6) and [s.last - s.first for s in Schedule.of(config).stages] == [2000, 4000]
    assert config.precision == "float32" and config.steps == 20 and not config.shadows and not config.indirect
    assert config.velocity_decay == 1
