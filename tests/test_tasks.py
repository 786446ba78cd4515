"""The five tasks on hand-made physics quantities, by hand, and the making of environments."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from sacformer_jax.envs import make_env
from sacformer_jax.envs.tasks import TASKS, Quantities

# nq, nv and number of bodies (the world included) of Gymnasium's models.
SIZES = {
    "HalfCheetah": (9, 9, 8),
    "Hopper": (6, 6, 5),
    "Walker2d": (9, 9, 8),
    "Ant": (15, 14, 14),
    "Humanoid": (24, 23, 14),
}
DERIVED_COLUMNS = {"cinert": 10, "cvel": 6, "cfrc_ext": 6}

# A position well within each task's limits.
HEALTHY = {
    "HalfCheetah": {},
    "Hopper": {1: 1.25},
    "Walker2d": {1: 1.25},
    "Ant": {2: 0.75},
    "Humanoid": {2: 1.4},
}

UP, DOWN = np.float32(np.inf), np.float32(-np.inf)


def beside(value: float, direction: np.float32) -> float:
    """The next float32 above or below ``value``."""
    return float(np.nextafter(np.float32(value), direction))


def quantities(name: str, qpos=None, qvel=None, **derived) -> Quantities:
    """All zeros but a healthy posture and what is given: index → value, or whole arrays."""
    nq, nv, num_bodies = SIZES[name]
    values = {"qpos": np.zeros(nq, np.float32), "qvel": np.zeros(nv, np.float32)}
    for field, entries in (("qpos", HEALTHY[name]), ("qpos", qpos or {}), ("qvel", qvel or {})):
        for index, value in entries.items():
            values[field][index] = value
    arrays = {}
    for quantity in TASKS[name].derived:
        columns = DERIVED_COLUMNS.get(quantity)
        shape = (num_bodies, columns) if columns else (nv,)
        arrays[quantity] = jnp.asarray(derived.get(quantity, np.zeros(shape, np.float32)))
        assert arrays[quantity].shape == shape
    return Quantities(
        qpos=jnp.asarray(values["qpos"]),
        qvel=jnp.asarray(values["qvel"]),
        displacement=jnp.zeros(2),
        derived=arrays,
    )


def encoded(name: str) -> Quantities:
    """Every entry a number of its own: thousands tell the quantity, the rest the flat index."""
    nq, nv, num_bodies = SIZES[name]
    thousands = {"cinert": 3000, "cvel": 4000, "qfrc_actuator": 5000, "cfrc_ext": 6000}
    derived = {}
    for quantity in TASKS[name].derived:
        columns = DERIVED_COLUMNS.get(quantity)
        size = num_bodies * columns if columns else nv
        flat = thousands[quantity] + jnp.arange(size, dtype=jnp.float32)
        derived[quantity] = flat.reshape(num_bodies, columns) if columns else flat
    return Quantities(
        qpos=1000 + jnp.arange(nq, dtype=jnp.float32),
        qvel=2000 + jnp.arange(nv, dtype=jnp.float32),
        displacement=jnp.array([7000.0, 7001.0]),  # in no observation
        derived=derived,
    )


# --- observations ----------------------------------------------------------------------------

EXPECTED_OBS = {
    "HalfCheetah": [*range(1001, 1009), *range(2000, 2009)],
    "Hopper": [*range(1001, 1006), *[10] * 6],
    "Walker2d": [*range(1001, 1009), *[10] * 9],
    "Ant": [*range(1002, 1015), *range(2000, 2014), *[1] * 78],
    "Humanoid": [
        *range(1002, 1024),
        *range(2000, 2023),
        *range(3010, 3140),
        *range(4006, 4084),
        *range(5006, 5023),
        *range(6006, 6084),
    ],
}


@pytest.mark.parametrize("name", TASKS)
def test_observation_holds_what_gymnasiums_does_in_its_order(name):
    obs = TASKS[name].observe(encoded(name))
    assert obs.dtype == jnp.float32
    assert obs.tolist() == EXPECTED_OBS[name]


@pytest.mark.parametrize("name", ["Hopper", "Walker2d"])
def test_planar_walkers_see_velocities_clipped_at_ten_either_way(name):
    q = quantities(name, qvel={0: -11.0, 1: -10.0, 2: -9.5, 3: 9.5, 4: 10.0, 5: 11.0})
    obs = TASKS[name].observe(q)[SIZES[name][0] - 1 :]
    assert obs[:6].tolist() == [-10.0, -10.0, -9.5, 9.5, 10.0, 10.0]


def test_half_cheetah_sees_velocities_unclipped():
    obs = TASKS["HalfCheetah"].observe(quantities("HalfCheetah", qvel={0: -11.0, 8: 25.0}))
    assert (obs[8].item(), obs[16].item()) == (-11.0, 25.0)


def test_ant_sees_contact_forces_clipped_at_one_and_none_of_the_world():
    forces = np.zeros((14, 6), np.float32)
    forces[0] = 0.5  # the world body
    forces[1] = [-3.0, -1.0, -0.25, 0.25, 1.0, 3.0]
    forces[13, 5] = 0.75
    obs = TASKS["Ant"].observe(quantities("Ant", cfrc_ext=forces))[27:]
    assert obs[:6].tolist() == [-1.0, -1.0, -0.25, 0.25, 1.0, 1.0]
    assert obs[-1] == 0.75
    assert jnp.all(obs[6:-1] == 0)


def test_humanoid_sees_contact_forces_unclipped():
    forces = np.zeros((14, 6), np.float32)
    forces[13] = [-300.0, 0.0, 1.0, 2.0, 3.0, 400.0]
    obs = TASKS["Humanoid"].observe(quantities("Humanoid", cfrc_ext=forces))
    assert obs[-6:].tolist() == [-300.0, 0.0, 1.0, 2.0, 3.0, 400.0]


# --- rewards ---------------------------------------------------------------------------------


def terms_of(name: str, q: Quantities, action: list[float], x_velocity: float) -> dict:
    terms = TASKS[name].reward_terms(q, jnp.array(action), jnp.float32(x_velocity))
    return {key: float(value) for key, value in terms.items()}


# The action [1, -2, 0, 0.5]: its squares sum to 5.25.
ACTION = [1.0, -2.0, 0.0, 0.5]


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("HalfCheetah", {"reward_forward": 3.0, "reward_ctrl": -0.525}),
        ("Hopper", {"reward_forward": 3.0, "reward_ctrl": -0.00525, "reward_survive": 1.0}),
        ("Walker2d", {"reward_forward": 3.0, "reward_ctrl": -0.00525, "reward_survive": 1.0}),
        (
            "Ant",
            {
                "reward_forward": 3.0,
                "reward_ctrl": -2.625,
                "reward_survive": 1.0,
                "reward_contact": 0.0,
            },
        ),
        (
            "Humanoid",
            {
                "reward_forward": 3.75,
                "reward_ctrl": -0.525,
                "reward_survive": 5.0,
                "reward_contact": 0.0,
            },
        ),
    ],
)
def test_reward_terms(name, expected):
    assert terms_of(name, quantities(name), ACTION, 3.0) == pytest.approx(expected, rel=1e-6)
    # Backwards, at rest: only the forward term changes, and it changes sign.
    backwards = {**expected, "reward_forward": -expected["reward_forward"], "reward_ctrl": 0.0}
    assert terms_of(name, quantities(name), [0.0] * 4, -3.0) == pytest.approx(backwards, rel=1e-6)


@pytest.mark.parametrize(
    ("name", "fallen"),
    [("Hopper", {1: 0.5}), ("Walker2d", {1: 0.5}), ("Ant", {2: 0.1}), ("Humanoid", {2: 0.9})],
)
def test_no_survival_reward_for_the_fallen(name, fallen):
    q = quantities(name, qpos=fallen)
    assert terms_of(name, q, ACTION, 3.0)["reward_survive"] == 0.0
    assert bool(TASKS[name].terminated(q))


def test_ant_pays_for_clipped_contact_forces_of_all_bodies():
    forces = np.zeros((14, 6), np.float32)
    forces[0, 0] = 0.5  # the world counts in the cost, though it is not observed
    forces[1] = [-3.0, 0.0, 0.5, 0.0, 0.0, 7.0]
    terms = terms_of("Ant", quantities("Ant", cfrc_ext=forces), ACTION, 0.0)
    assert terms["reward_contact"] == pytest.approx(-5e-4 * (0.25 + 1 + 0.25 + 1), rel=1e-6)


@pytest.mark.parametrize(("force", "cost"), [(1000.0, 0.5), (4000.0, 8.0), (5000.0, 10.0)])
def test_humanoid_pays_for_contact_forces_up_to_ten(force, cost):
    forces = np.zeros((14, 6), np.float32)
    forces[3, 2] = force  # 5e-7 · 5000² would be 12.5
    terms = terms_of("Humanoid", quantities("Humanoid", cfrc_ext=forces), ACTION, 0.0)
    assert terms["reward_contact"] == pytest.approx(-cost, rel=1e-6)


# --- termination -----------------------------------------------------------------------------

# (task, qpos entries, qvel entries, terminated)
BOUNDARIES = [
    # Hopper: z > 0.7, |angle| < 0.2, everything behind z within ±100, all exclusive.
    ("Hopper", {1: 0.7}, {}, True),
    ("Hopper", {1: beside(0.7, UP)}, {}, False),
    ("Hopper", {1: 1e3}, {}, False),
    ("Hopper", {0: 1e3}, {}, False),
    ("Hopper", {0: -1e3}, {}, False),
    ("Hopper", {2: 0.2}, {}, True),
    ("Hopper", {2: beside(0.2, DOWN)}, {}, False),
    ("Hopper", {2: -0.2}, {}, True),
    ("Hopper", {2: beside(-0.2, UP)}, {}, False),
    ("Hopper", {3: 100.0}, {}, True),
    ("Hopper", {5: beside(100.0, DOWN)}, {}, False),
    ("Hopper", {5: -100.0}, {}, True),
    ("Hopper", {}, {0: 100.0}, True),
    ("Hopper", {}, {0: beside(100.0, DOWN)}, False),
    ("Hopper", {}, {5: -100.0}, True),
    ("Hopper", {}, {5: beside(-100.0, UP)}, False),
    # Walker2d: 0.8 < z < 2, |angle| < 1; velocities and joints do not matter.
    ("Walker2d", {1: 0.8}, {}, True),
    ("Walker2d", {1: beside(0.8, UP)}, {}, False),
    ("Walker2d", {1: 2.0}, {}, True),
    ("Walker2d", {1: beside(2.0, DOWN)}, {}, False),
    ("Walker2d", {2: 1.0}, {}, True),
    ("Walker2d", {2: beside(1.0, DOWN)}, {}, False),
    ("Walker2d", {2: -1.0}, {}, True),
    ("Walker2d", {2: beside(-1.0, UP)}, {}, False),
    ("Walker2d", {0: 1e3, 5: 150.0}, {3: 150.0}, False),
    # Ant: 0.2 ≤ z ≤ 1, inclusive, and everything finite.
    ("Ant", {2: 0.2}, {}, False),
    ("Ant", {2: beside(0.2, DOWN)}, {}, True),
    ("Ant", {2: 1.0}, {}, False),
    ("Ant", {2: beside(1.0, UP)}, {}, True),
    ("Ant", {0: -1e3, 14: 150.0}, {13: 150.0}, False),
    ("Ant", {0: np.inf}, {}, True),
    ("Ant", {}, {13: np.nan}, True),
    # Humanoid: 1 < z < 2, exclusive.
    ("Humanoid", {2: 1.0}, {}, True),
    ("Humanoid", {2: beside(1.0, UP)}, {}, False),
    ("Humanoid", {2: 2.0}, {}, True),
    ("Humanoid", {2: beside(2.0, DOWN)}, {}, False),
    ("Humanoid", {0: 1e3, 23: 150.0}, {22: 150.0}, False),
    # HalfCheetah never.
    ("HalfCheetah", {1: -5.0, 2: 7.0, 8: 1e3}, {0: 1e3, 8: -1e3}, False),
]


@pytest.mark.parametrize(("name", "qpos", "qvel", "terminated"), BOUNDARIES)
def test_termination_at_the_boundaries(name, qpos, qvel, terminated):
    answer = TASKS[name].terminated(quantities(name, qpos, qvel))
    assert answer.dtype == bool
    assert answer.shape == ()
    assert bool(answer) is terminated


# --- making environments ---------------------------------------------------------------------


@pytest.mark.parametrize("name", ["Cheetah", "halfcheetah", "", "brax:cheetah"])
def test_unknown_environments_are_refused_with_what_there_is(name):
    with pytest.raises(ValueError, match="no such environment") as refusal:
        make_env(name)
    message = str(refusal.value)
    assert repr(name) in message
    assert "brax:ant" in message
    assert name.startswith("brax:") or all(task in message for task in TASKS)


def test_unknown_engine_is_refused_with_what_there_is():
    for name, choice, message in (
        ("gym:Pendulum-v1", {"engine": "mjx"}, "engine='mjx': env='gym:Pendulum-v1' has its own"),
        ("brax:ant", {"engine": "native"}, "chosen by brax_backend"),
        ("Hopper", {"brax_backend": "mjx"}, "brax_backend='mjx': is for env=brax:NAME"),
        (
            "Hopper",
            {"engine": "native", "mjx_preset": "fast"},
            "mjx_preset='fast': is for engine=mjx, not engine=native",
        ),
        (
            "brax:ant",
            {"mjx_impl": "warp"},
            "mjx_impl='warp': .*, not env='brax:ant'",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            make_env(name, **choice)
    with pytest.raises(ValueError, match=r"engine='bullet'.*auto.*native"):
        make_env("Hopper", engine="bullet")


def test_automatic_choice_of_the_engine_is_told_with_its_reason():
    chosen, asked = make_env("Hopper").spec, make_env("Hopper", engine="native").spec
    assert chosen.engine == asked.engine == "native"
    assert "auto" in chosen.engine_reason
    assert chosen.engine_reason != asked.engine_reason
