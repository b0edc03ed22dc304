"""``python -m tiptrace``."""

from tiptrace.cli import main

if __name__ == "__main__":
    main()
