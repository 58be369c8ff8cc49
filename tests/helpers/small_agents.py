"""Tiny settings, with which agents and their observers train fast and badly."""

from training import calibration as calibrate
from training.agents import learning, observing
from training.sources import recorded

NET = {"policy": "MlpPolicy", "policy_kwargs": {"net_arch": [8]}, "n_timesteps": 64}
PPO = {**NET, "n_envs": 2, "n_steps": 16, "batch_size": 16}
OFF_POLICY = {**NET, "learning_starts": 32}
SETTINGS = {
    "ppo": {**PPO, "normalize": True},
    "a2c": {**NET, "n_envs": 2, "n_steps": 16},
    "dqn": OFF_POLICY,
    "sac": OFF_POLICY,
    "tqc": OFF_POLICY,
    "td3": {**OFF_POLICY, "noise_type": "normal", "noise_std": 0.1},
    "ppo_lstm": {**PPO, "policy": "MlpLstmPolicy"},
}
OBSERVERS = {"inverse_steps": 20, "members": 1, "width": 8, "samples": 5, "windows": 200, "batch": 64}


def make_small(monkeypatch):
    written = learning.settings_of

    def settings_of(name):
        known = {"default": SETTINGS.get(name) or written(name)["default"]}
        return known | ({"Pendulum-v1": SETTINGS[name]} if name == "sac" else {})  # as in sac.yml

    monkeypatch.setattr(learning, "settings_of", settings_of)
    monkeypatch.setattr(observing, "SETTINGS", OBSERVERS)
    monkeypatch.setattr(recorded, "FEWEST", 2)
    monkeypatch.setattr(calibrate, "FEWEST", 2)
