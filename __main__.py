"""``python -m mirrorskin``: the command line."""

from mirrorskin.cli.main import program

if __name__ == "__main__":
    program()
