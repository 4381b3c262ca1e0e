"""Prints what the environment needs before the package: its own, its tests' and its build's requirements."""

import configparser
import tomllib
from pathlib import Path

HERE = Path(__file__).resolve().parents[1]


def main() -> None:
    """Read setup.cfg and pyproject.toml, the places that name them; one requirement a line."""
    setup_cfg = configparser.ConfigParser()
    setup_cfg.read(HERE / 'setup.cfg', encoding='utf-8')
    needed = setup_cfg['options']['install_requires'].split('\n')
    needed += setup_cfg['options.extras_require']['test'].split('\n')
    needed += tomllib.loads((HERE / 'pyproject.toml').read_text())['build-system']['requires']
    print('\n'.join(line.strip() for line in needed if line.strip()))


if __name__ == '__main__':
    main()
