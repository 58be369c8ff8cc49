"""Van der Pol: the spectrum of its observer, its settings and control task, and why they were chosen.

Its equation is :class:`kkl_gym.systems.VanDerPol`.
"""

from training.spectrum import evenly_spaced
from training.systems.profile import Profile
from training.systems.task import control_task

PROFILE = Profile(
    # Of input-aware maps. Fast ones follow the jumps of y, slow ones average its noise. Their
    # number and ends are as measured, by the errors of trained observers.
    eigenvalues=evenly_spaced(15, -0.4, -20.0),
    # Slower modes have a rougher T; more of them average more of the noise.
    spinn_settings={"eigenvalues": evenly_spaced(11, -4.0, -16.0), "noise_free_share": 0.2, "high_noise_emphasis": 4.5},
    # Noise hides its phase most of all: more samples at high noise help. No input within its bound leads the oscillator
    # out of X, so stronger ones do.
    settings={"lead_in_input": 4.0, "noise_free_share": 0.05, "high_noise_emphasis": 4.0},
    # Of a T_inv that stands alone. Slow complex modes at frequencies of y average its noise.
    large_settings={
        "pairs": ((-0.1, 0.718), (-0.1, 2.128), (-0.1, 0.6836), (-0.3, 0.718)),
        "inverse_steps": 24000,
        "learning_rate": 2.5e-3,
    },
    fault_deadline=8.9,  # a period
    # The target is unstable. Starts keep to |x1| < 3: beyond it a slow manifold holds the motion, whatever one does.
    task=control_task("van_der_pol", start_box=((-3, 3), (-6, 6))),
    second_noise=0.2,
    printed={"spinn": 0.35, "ae": 200.0, "dmf": 98.2, "node": 11.9},
)
