"""``python -m training`` and the ``kkl-gym`` script."""

import sys


def main() -> None:
    """Run the command line, or say what to install."""
    try:
        from training.cli import main as run
    except ImportError as error:
        sys.exit(f'kkl-gym: {error}; the commands need: pip install "kkl-gym[train,plots]"')
    run()


if __name__ == "__main__":
    main()
