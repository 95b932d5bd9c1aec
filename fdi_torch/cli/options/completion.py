"""Print a script with which a shell completes commands, options, their choices and file names."""

SHELLS = ("bash", "zsh", "fish")
STEP, SUMMARY = "use", "print a script with which a shell completes commands and options"
QUICK = True
EXAMPLES = """
examples:
  fdi completion bash > ~/.local/share/bash-completion/completions/fdi    in each new shell from then on
  fdi completion zsh > ~/.zsh/_fdi                                        likewise, if ~/.zsh is in $fpath
"""
ARGUMENTS = {"shell": {"choices": SHELLS, "help": "the shell that reads the script"}}
