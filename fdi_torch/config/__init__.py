"""Configuration: strict models of plant files and run files, with units; errors are sentences."""

from fdi_torch.config.loaded_recordings import LoadedRecording, load_recordings, read_frame, read_recording
from fdi_torch.config.plant_file import build_plant, load_plant
from fdi_torch.config.plant_writer import dump_plant
from fdi_torch.config.problems import ConfigError
from fdi_torch.config.recording_config import RecordingConfig
from fdi_torch.config.run_file import Run, RunConfig, build_run, load_run

__all__ = [
    "ConfigError",
    "LoadedRecording",
    "RecordingConfig",
    "Run",
    "RunConfig",
    "build_plant",
    "build_run",
    "dump_plant",
    "load_plant",
    "load_recordings",
    "load_run",
    "read_frame",
    "read_recording",
]
