"""Make the pictures of the gallery and of the guide: python docs/pictures.py.

Each example saves its own, so that a picture shows what its code does.
"""

import subprocess
import sys
from pathlib import Path

DOCS = Path(__file__).parent

if __name__ == "__main__":
    for example in sorted((DOCS.parent / "examples").glob("*.py")):
        subprocess.run([sys.executable, example], cwd=DOCS / "gallery", check=True)
