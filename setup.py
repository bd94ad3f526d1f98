"""Packaging: colcon (ament_python), pip and ``ros2 run`` all install the package from here."""

import os
import runpy
import sys
from pathlib import Path

from setuptools import find_packages, setup

NAME = "csas_shadow_ros"
#: Names of the nodes: from the package's own table, which needs nothing that is not installed yet.
NODES = tuple(runpy.run_path(str(Path(__file__).resolve().parent / NAME / "node_table.py"))["NODES"])

# Floors are what Ubuntu 24.04 has beside ROS 2 Jazzy (constraints/noble.txt), and were tried.
CORE = [
    "numpy>=1.26",
    "scipy>=1.11.4",
    "scikit-image>=0.22",
    "trimesh>=4.4",
    "opencv-python-headless>=4.6",
    "numba>=0.58.1",
    "ducc0>=0.34",
    "matplotlib>=3.6.3",
    "tqdm>=4.66",
    "lazy_loader>=0.4",
    "PyYAML>=6.0",
    "mcap>=1.2",
    "zstandard>=0.22",
    "lz4>=4.0.2",
    # The bag format's reader and message definitions: its interface moves between minor versions.
    "rosbags>=0.11,<0.12",
    # Rays of simulated scenes, faster than our own; there is no wheel for Linux on ARM64.
    'embreex>=2.17.7; sys_platform == "darwin" or platform_machine in "x86_64 AMD64"',
    # The operator's view: its server, and pictures of views.
    "aiohttp>=3.9.1,<4",
    "pillow>=10.1",
]
# ROS 2 Jazzy from PyPI, in versions that were tried together. Where ROS 2 is installed by other means
# (apt, conda, source) this extra is not needed and would be in the way. The wheels are for x86-64 alone.
ROS = ["ros-rclpy==7.1.6", "ros-rmw-fastrtps-cpp==8.4.3", "ros-common-interfaces==5.3.6"]
# pytest 8 does not start beside Jazzy's launch_testing: Ubuntu 24.04 has 7.4.4.
TEST = ["pytest>=7.4.4", "pytest-xdist>=3.4", "hypothesis>=6.98", "ruff~=0.17.6", "mypy~=2.4.1"]
# What scene metres to latitude and longitude are compared with.
TEST += ["pyproj>=3.6"]
TEST += ["packaging>=23"]
# The viewer's page is tested in Debian's chromium; no browser is downloaded.
TEST += ["playwright>=1.49,<2"]
# Results as labelled arrays.
XARRAY = ["xarray>=2023.1"]
TEST += XARRAY
# Archives: Parquet tables, questions to them in SQL, and clusters that process bags.
ARCHIVE = ["pyarrow>=15", "duckdb>=1.1"]
CLUSTER = ["distributed>=2024.1"]
TEST += ARCHIVE
TEST += CLUSTER
# Charts: GeoTIFF and vectors by GDAL, labelled arrays as NetCDF and Zarr.
MAPS = ["rasterio>=1.3.10", "pyogrio>=0.7.2", "h5netcdf>=1.3", "h5py>=3.10", "zarr>=2.18", "xarray>=2024.10"]
# Keys and permissions for SROS 2.
SECURITY = ["cryptography>=41"]
TEST += SECURITY
# Images and navigation of others.
IMPORT = ["rasterio>=1.3.10", "h5py>=3.10", 'sarkit>=1.0; python_version >= "3.11"']
TEST += MAPS
TEST += IMPORT
# Read back what was written, as users do.
TEST += ["geopandas>=0.14.3"]
# The benchmark compares with the fastest FFT library that can be had: a floor to measure against.
BENCH = ["pyfftw>=0.14"]
# The site. MkDocs 2 takes no plugins; equations become MathML when the site is built.
DOCS = [
    "mkdocs>=1.6,<2",
    "mkdocs-material>=9.6,<10",
    "mkdocstrings[python]>=0.29",
    "mkdocs-jupyter>=0.25",
    "latex2mathml>=3.77",
    "ipykernel>=6.29",
]
# setuptools 80 dropped what colcon's --symlink-install calls.
BUILD = ["colcon-common-extensions>=0.3", "setuptools>=68,<80"]

ROOT = Path(__file__).resolve().parent


def version() -> str:
    """Read the version from the package, which is its one home."""
    text = (ROOT / NAME / "__init__.py").read_text(encoding="utf-8")
    return text.split('__version__ = "', 1)[1].split('"', 1)[0]


def read_me() -> str:
    """Return the README, empty in a tree without one."""
    path = ROOT / "README.md"
    return path.read_text(encoding="utf-8") if path.exists() else ""


def files_below(folder: str) -> list[tuple[str, list[str]]]:
    """Return data_files entries that keep a folder's layout below share/NAME."""
    found = []
    for path, _, _ in os.walk(folder):
        files = sorted(str(f) for f in Path(path).glob("*") if f.is_file() and f.suffix != ".pyc")
        if files and "__pycache__" not in path:
            found.append((f"share/{NAME}/{path}", files))
    return found


def node_scripts() -> list[tuple[str, list[str]]]:
    """Make what ``ros2 run`` looks for when pip installs a wheel.

    pip ignores setup.cfg's install_scripts (which serves colcon) and puts console scripts into bin/;
    ``ros2 run`` and the launch file look in lib/NAME. So a wheel carries one small script a node there,
    and one for the command line.
    """
    if "bdist_wheel" not in sys.argv:
        return []
    folder = Path("build") / "ros2_run"
    folder.mkdir(parents=True, exist_ok=True)
    scripts = []
    for name in ("csas-shadow", *NODES):
        script = folder / name
        script.write_text(f'#!/bin/sh\nexec "$(dirname "$0")/../../bin/{name}" "$@"\n', encoding="utf-8")
        script.chmod(0o755)
        scripts.append(str(script))
    return [(f"lib/{NAME}", scripts)]


setup(
    name=NAME,
    version=version(),
    description="Shadow enhancement, sub-aperture imagery and 3-D space carving for circular SAS, in ROS 2",
    long_description=read_me(),
    long_description_content_type="text/markdown",
    author="The csas_shadow_ros authors",
    author_email="csas-shadow-ros@example.com",
    maintainer="The csas_shadow_ros authors",
    maintainer_email="csas-shadow-ros@example.com",
    license="MIT",
    python_requires=">=3.10,<3.14",
    classifiers=[
        "Operating System :: POSIX :: Linux",
        *(f"Programming Language :: Python :: 3.{minor}" for minor in range(10, 14)),
    ],
    packages=find_packages(include=[f"{NAME}*", "msg_adapters*"]),
    package_data={
        NAME: ["py.typed", "*.pyi", "**/*.html", "**/*.js", "**/*.css", "**/*.svg", "**/*.xml", "**/*.yaml"],
        "msg_adapters": ["py.typed"],
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *files_below("launch"),
        *files_below("config"),
        *node_scripts(),
    ],
    install_requires=CORE,
    extras_require={
        "ros": ROS,
        "xarray": XARRAY,
        "archive": ARCHIVE,
        "cluster": ARCHIVE + CLUSTER,
        "maps": MAPS,
        "import": IMPORT,
        "security": SECURITY,
        "test": TEST,
        "bench": BENCH,
        "build": BUILD,
        "docs": DOCS,
        "dev": TEST + BUILD + DOCS,
    },
    entry_points={
        "console_scripts": [
            "csas-shadow = csas_shadow_ros.__main__:main",
            *(f"{node} = {NAME}.nodes.runtime.start:{node}" for node in NODES),
        ]
    },
    zip_safe=False,
)
