"""Figures and animations: `from jaxslam.viz import maps`; README.md lists the modules.

Nothing is imported here, because matplotlib is slow to import.
"""
