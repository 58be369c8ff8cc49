"""Seeds of the episodes on which agents learn and are evaluated; no evaluation uses a seed of a training."""

# Base seeds. The functions below add an offset for ``seed``; seeds of parallel episodes count up from the result.
AGENT_TRAINING_SEED = 10_000
AGENT_EVALUATION_SEED = 10**9
AGENT_EVALUATION_EPISODES = 10_000  # largest number of episodes of an evaluation


def agent_training_seed(seed: int, resumed: int = 0, rows: int = 1) -> int:
    """Return the seed of the first of ``rows`` parallel environments after ``resumed`` restarts of a training."""
    most = AGENT_EVALUATION_SEED // AGENT_TRAINING_SEED - 2
    if not 0 <= seed <= most:
        raise ValueError(f"an agent's seed must lie between 0 and {most}, got {seed}")
    return AGENT_TRAINING_SEED * (seed + 1) + resumed * rows % (AGENT_TRAINING_SEED - rows)


def agent_evaluation_seed(seed: int, episodes: int) -> int:
    """Return the seed of an evaluation's first episode; evaluations with different seeds share no episode."""
    if seed < 0 or not 1 <= episodes <= AGENT_EVALUATION_EPISODES:
        most = AGENT_EVALUATION_EPISODES
        raise ValueError(f"seed must be at least 0, and episodes from 1 to {most}; got {seed} and {episodes}")
    return AGENT_EVALUATION_SEED + AGENT_EVALUATION_EPISODES * seed
