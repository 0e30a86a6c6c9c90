"""The command line `jaxslam`: `jaxslam.cli.main.main`; README.md here lists commands and files.

Nothing is imported here, so that a command imports only what it needs.
"""
