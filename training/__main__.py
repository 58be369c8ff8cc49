"""``python -m training``, the same as the ``kkl-gym`` script."""

from training.cli import main

if __name__ == "__main__":
    main()
