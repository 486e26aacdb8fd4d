"""``python -m servofd``."""

from servofd.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
