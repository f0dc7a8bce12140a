"""Safety layer in front of any Rig: soft limits, speed cap, watchdog, emergency stop, frame age, halt at every exit.

It runs in the same process as the program that it watches. It cannot act when that process is killed at once (SIGKILL),
frozen (SIGSTOP; on Ctrl-Z, another signal, the head is halted first), or blocked by a C library that holds Python's
interpreter lock. The head then ends at the goal of its last command, which lies within the soft limits.
"""
