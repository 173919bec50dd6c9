"""The room where a step becomes machine code: recorded from ``Simulator.step``, never written beside it.

``scalar`` records a step as a graph of numbers, derives and prints it. ``kernels`` are loops around what is printed.
They also record whole steps of environments as rows. ``records`` are loops over measured records.
"""
