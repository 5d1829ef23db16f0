"""The commands of ``sb3-ars``, a module each with ``main(arguments)``: read arguments, call the package, print."""
