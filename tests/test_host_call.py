"""Python functions inside jitted programs: equal to ``jax.pure_callback``, in name and in error."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sacformer_jax.envs.host_call import HostCall

NAMES = map("tests.host_call.{}".format, itertools.count())
RESULTS = (
    jax.ShapeDtypeStruct((3,), jnp.float32),
    jax.ShapeDtypeStruct((), jnp.int32),
    jax.ShapeDtypeStruct((2,), jnp.bool_),
)


def host(x, n):
    """``x [..., 3]`` float32 and ``n [...]`` int32."""
    x, n = np.asarray(x), np.asarray(n)
    return x * n[..., None], n + 1, np.stack([n > 0, n > 1], axis=-1)


@pytest.fixture(scope="module")
def call():
    by_name = HostCall(next(NAMES), host)
    return lambda x, n: by_name(RESULTS, x, n)


def operands(*leading):
    rng = np.random.default_rng(0)
    return (
        jnp.asarray(rng.normal(size=(*leading, 3)), jnp.float32),
        jnp.asarray(rng.integers(0, 3, leading), jnp.int32),
    )


def assert_equal(actual, expected):
    for a, b, result in zip(actual, expected, RESULTS, strict=True):
        assert a.dtype == result.dtype
        np.testing.assert_array_equal(a, b)


def test_equals_the_function_with_jit_and_without(call):
    x, n = operands()
    assert_equal(call(x, n), host(x, n))
    assert_equal(jax.jit(call)(x, n), host(x, n))


@pytest.mark.parametrize("leading", [(1,), (4,), (0,), (2, 3)])
def test_vmap_adds_leading_axes(call, leading):
    x, n = operands(*leading)
    mapped = call
    for _ in leading:
        mapped = jax.vmap(mapped)
    assert_equal(jax.jit(mapped)(x, n), host(x, n))


def test_all_environments_are_one_call_and_what_is_not_mapped_is_repeated():
    shapes = []

    def noted(x, n):
        shapes.append((np.shape(x), np.shape(n)))
        return host(x, n)

    by_name = HostCall(next(NAMES), noted)
    x, n = operands(2, 4)
    both = jax.vmap(jax.vmap(lambda x, n: by_name(RESULTS, x, n), (0, None)), (0, 0))
    assert_equal(jax.jit(both)(x, n[:, 0]), host(x, np.repeat(n[:, :1], 4, axis=1)))
    assert shapes == [((2, 4, 3), (2, 4))]


def test_in_a_scan(call):
    def turn(carry, _):
        x, n = carry
        y, m, _ = call(x, n)
        return (y, m), y

    x = jnp.ones(3)
    (last, n), _ = jax.jit(lambda x: jax.lax.scan(turn, (x, jnp.int32(1)), length=5))(x)
    assert int(n) == 6
    np.testing.assert_array_equal(last, 120.0 * x)


def test_an_error_surfaces_with_its_traceback_and_the_next_call_works():
    def picky(x, n):
        if np.any(n == 2):
            raise ValueError("two is refused")
        return host(x, n)

    by_name = HostCall(next(NAMES), picky)
    run = jax.jit(lambda x, n: by_name(RESULTS, x, n))
    x = jnp.ones(3)
    for _ in range(3):
        with pytest.raises(jax.errors.JaxRuntimeError, match="two is refused") as caught:
            jax.block_until_ready(run(x, jnp.int32(2)))
        assert "in picky" in str(caught.value)
        assert_equal(run(x, jnp.int32(1)), host(x, np.int32(1)))


def test_a_result_of_the_wrong_shape_is_an_error():
    by_name = HostCall(next(NAMES), lambda x: [np.zeros(7)])
    with pytest.raises(jax.errors.JaxRuntimeError, match="broadcast"):
        jax.block_until_ready(jax.jit(lambda x: by_name(RESULTS[:1], x))(jnp.ones(3)))


def test_a_name_is_taken_once():
    name = next(NAMES)
    HostCall(name, host)
    with pytest.raises(ValueError, match="registered already"):
        HostCall(name, host)


def test_other_platforms_take_the_general_way(call, monkeypatch):
    x, n = operands(4)
    monkeypatch.setattr(
        jax.lax, "platform_dependent", lambda *args, default, **platforms: default(*args)
    )
    mapped = jax.vmap(lambda x, n: call(x, n))
    assert "pure_callback" in str(jax.make_jaxpr(mapped)(x, n))
    assert_equal(jax.jit(mapped)(x, n), host(x, n))


PROGRAM = """
import sys
import jax, jax.numpy as jnp, numpy as np
jax.config.update("jax_compilation_cache_dir", sys.argv[1])
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
hits = []
jax.monitoring.register_event_listener(lambda event, **_: hits.append(event))
from sacformer_jax.envs.host_call import HostCall
call = HostCall("tests.cached", lambda x: [np.asarray(x) + float(sys.argv[2])])
found = jax.jit(lambda x: call((jax.ShapeDtypeStruct((2,), jnp.float32),), x))(jnp.zeros(2))
print(float(found[0][0]), sum("cache_hits" in event for event in hits))
"""


def test_another_process_finds_the_program_in_the_cache(tmp_path):
    """And calls its own function, by the name."""
    outputs = []
    for number in ("1.5", "2.5"):
        result = subprocess.run(
            [sys.executable, "-c", PROGRAM, str(tmp_path), number],
            env={**os.environ, "JAX_ENABLE_COMPILATION_CACHE": "true"},
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        outputs.append(result.stdout.split())
    assert outputs[0] == ["1.5", "0"]
    assert outputs[1][0] == "2.5"
    assert int(outputs[1][1]) >= 1
