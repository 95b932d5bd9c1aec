"""`python -m fdi_torch COMMAND` is `fdi COMMAND`."""

from fdi_torch.cli import command_line

if __name__ == "__main__":
    command_line()
