"""``python -m csas_shadow_ros.cli``."""

from .main import run_and_exit

if __name__ == "__main__":
    run_and_exit()
