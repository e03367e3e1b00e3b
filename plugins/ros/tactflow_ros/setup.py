"""Install the package for ROS 2."""

from setuptools import setup

NAME = "tactflow_ros"

setup(
    name=NAME,
    version="0.1.0",
    description="Topics from a running tactflow",
    license="MIT",
    maintainer="tactflow developers",
    maintainer_email="maintainers@tactflow.invalid",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/tactflow.launch.py", "launch/two_sensors.launch.py"]),
        (f"share/{NAME}/config", ["config/tactflow.yaml", "config/two_sensors.rviz"]),
    ],
    install_requires=["setuptools", "numpy", "pyzmq"],
    extras_require={"test": ["pytest"]},
    zip_safe=True,
    entry_points={"console_scripts": [f"bridge = {NAME}.__main__:main"]},
)
