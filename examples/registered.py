"""Register an environment id with its wrappers: the agent sees x_hat and acts every 0.05 s.

CleanRL, TorchRL and many others make an environment from its id only. With this file in the working directory they take
"registered:VanDerPolEstimated-v0". For your own id, copy the file and change the system and the wrappers.
"""

import gymnasium as gym

from kkl_gym import ActionRepeat, KKLObservation

gym.register(
    "VanDerPolEstimated-v0",
    entry_point="kkl_gym:KKLEnv",
    kwargs={"system": "van_der_pol", "measurement_noise": 0.2},
    max_episode_steps=2000,  # samples of 0.01 s
    additional_wrappers=(KKLObservation.wrapper_spec(observer="van_der_pol"), ActionRepeat.wrapper_spec(repeat=5)),
)
