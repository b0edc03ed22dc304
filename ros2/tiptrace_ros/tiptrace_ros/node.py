"""Entry point: tiptrace's own node, with the arguments that ROS 2 gives."""

import sys

from tiptrace.errors import TipTraceError
from tiptrace.ros.node import run


def main() -> None:
    """Run the node; known errors become one sentence and exit code 2."""
    try:
        run(sys.argv[1:])
    except TipTraceError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
