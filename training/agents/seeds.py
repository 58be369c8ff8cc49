"""Seeds of the episodes on which agents learn and are evaluated; no two purposes share one."""

# Seeds of the first episodes; later episodes count up from them. A training multiplies its seed by (agent's seed + 1).
AGENT_TRAINING_SEED = 10_000
AGENT_EVALUATION_SEED = 10**9
AGENT_EVALUATION_EPISODES = 10_000  # largest number of episodes in an evaluation


def agent_training_seed(seed: int, resumed: int = 0, rows: int = 1) -> int:
    """Seed of the first episode on which an agent learns; the other rows count up from it."""
    most = AGENT_EVALUATION_SEED // AGENT_TRAINING_SEED - 2
    if not 0 <= seed <= most:
        raise ValueError(f"an agent's seed must lie between 0 and {most}, got {seed}")
    return AGENT_TRAINING_SEED * (seed + 1) + resumed * rows % (AGENT_TRAINING_SEED - rows)


def agent_evaluation_seed(seed: int, episodes: int) -> int:
    """Seed of the first episode of an evaluation; evaluations with different seeds share no episode."""
    if seed < 0 or not 1 <= episodes <= AGENT_EVALUATION_EPISODES:
        raise ValueError(
            f"seed must not be negative, and episodes from 1 to {AGENT_EVALUATION_EPISODES}; got {seed} and {episodes}"
        )
    return AGENT_EVALUATION_SEED + AGENT_EVALUATION_EPISODES * seed
