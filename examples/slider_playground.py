"""An environment of your own in the style of MuJoCo Playground: bring a slider to the middle."""

import jax
import jax.numpy as jnp
import mujoco
from ml_collections import config_dict
from mujoco import mjx
from mujoco_playground._src import mjx_env

from sacformer_jax import Config, train

XML = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <body><joint name="slide" type="slide" axis="1 0 0" damping="1"/><geom size="0.1"/></body>
  </worldbody>
  <actuator><motor joint="slide" gear="10" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


class Slider(mjx_env.MjxEnv):
    def __init__(self) -> None:
        super().__init__(config_dict.create(ctrl_dt=0.02, sim_dt=0.01, episode_length=100))
        self._mj_model = mujoco.MjModel.from_xml_string(XML)
        self._mjx_model = mjx.put_model(self._mj_model)

    def reset(self, rng: jax.Array) -> mjx_env.State:
        start = jax.random.uniform(rng, (1,), minval=-1.0, maxval=1.0)
        data = mjx.forward(self._mjx_model, mjx.make_data(self._mjx_model).replace(qpos=start))
        zero = jnp.zeros(())
        return mjx_env.State(data, self._observe(data), zero, zero, {"reward_near": zero}, {})

    def step(self, state: mjx_env.State, action: jax.Array) -> mjx_env.State:
        data = mjx_env.step(self._mjx_model, state.data, action, self.n_substeps)
        near = jnp.exp(-4 * data.qpos[0] ** 2)
        metrics = {"reward_near": near}
        return state.replace(data=data, obs=self._observe(data), reward=near, metrics=metrics)

    def _observe(self, data: mjx.Data) -> jax.Array:
        return jnp.concatenate([data.qpos, data.qvel])

    xml_path = property(lambda self: "")
    action_size = property(lambda self: 1)
    mj_model = property(lambda self: self._mj_model)
    mjx_model = property(lambda self: self._mjx_model)


if __name__ == "__main__":
    train(Config.from_preset("cpu", env="slider_playground:Slider", total_env_steps=10_000))
