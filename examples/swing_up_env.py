"""An environment of your own for Brax: one hinge, to be swung up and held there."""

import jax
import jax.numpy as jnp
from brax.envs.base import PipelineEnv, State
from brax.io import mjcf

from sacformer_jax import Config, train

XML = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <body name="rod">
      <joint name="hinge" axis="0 1 0" damping="0.02"/>
      <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.5" mass="0.5" contype="0"/>
    </body>
  </worldbody>
  <actuator><motor joint="hinge" gear="1.5" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


class SwingUp(PipelineEnv):
    max_episode_steps = 200  # without it 1,000

    def __init__(self, backend: str = "generalized"):
        super().__init__(mjcf.loads(XML), n_frames=2, backend=backend)

    def reset(self, rng: jax.Array) -> State:
        hanging = jax.random.uniform(rng, (1,), minval=-0.1, maxval=0.1)
        physics = self.pipeline_init(hanging, jnp.zeros(1))
        obs, zero = self._observe(physics.q, physics.qd), jnp.zeros(())
        return State(physics, obs, reward=zero, done=zero, metrics={"reward_height": zero})

    def step(self, state: State, action: jax.Array) -> State:
        physics = self.pipeline_step(state.pipeline_state, action)
        height = -jnp.cos(physics.q[0])  # 1 upright, -1 hanging
        return state.replace(
            pipeline_state=physics,
            obs=self._observe(physics.q, physics.qd),
            reward=height - 0.01 * jnp.sum(action**2),
            metrics={"reward_height": height},
        )

    def _observe(self, q: jax.Array, qd: jax.Array) -> jax.Array:
        return jnp.concatenate([jnp.cos(q), jnp.sin(q), qd])


if __name__ == "__main__":
    train(Config.from_preset("cpu", env="swing_up_env:SwingUp", total_env_steps=20_000))
