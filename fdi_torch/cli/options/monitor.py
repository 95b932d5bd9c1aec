"""Monitor a plant along a recording: alarms, faults with onset and size, and recoveries, one line per event."""

from fdi_torch.cli.options import config, seconds, shared

STEP, SUMMARY = "monitor", "detect, isolate and size faults along a recording or live"
LONG = True
EXAMPLES = """
examples:
  fdi monitor --config monitor.yaml                along a recording
  fdi monitor --config monitor.yaml --follow       along a CSV file that is still being written
  fdi monitor --config monitor.yaml --source mqtt://broker/rig      along a live source
  fdi monitor --config monitor.yaml --resume       continue a killed run
  fdi monitor --config monitor.yaml --live         with a live view in Foxglove or Lichtblick
"""
ARGUMENTS = {
    **config(
        "fdi_torch.config.monitor_file:MonitorConfig", required=True, kind="monitor", example="false_alarms_every='1 h'"
    ),
    **shared("--out", "--resume", "--live"),
    "--follow": {"action": "store_true", "help": "the file is still being written; process its samples as they come"},
    "--source": {
        "metavar": "URL",
        "help": "live source mqtt://HOST[:PORT][/TOPIC], opcua://HOST[:PORT][/PATH] or modbus://HOST[:PORT]; the file "
        "maps its tags under `source` (needs the extra `mqtt`, `opcua` or `modbus`)",
    },
    "--idle": {
        "metavar": "TIME",
        "type": seconds,
        "help": "end after this time without samples (60 s with --follow, never with a live source)",
    },
    "--publish": {
        "metavar": "URL",
        "help": "publish each event as JSON to mqtt://HOST[:PORT]/TOPIC: TOPIC/event, and TOPIC/state with the latest "
        "state (needs the extra `mqtt`)",
    },
    "--metrics": {
        "metavar": "[HOST:]PORT",
        "nargs": "?",
        "const": "127.0.0.1:9464",
        "help": "serve Prometheus metrics (without a value: 127.0.0.1:9464, reachable from this machine only; "
        "0.0.0.0:PORT opens them to the whole network without a password; needs the extra `prometheus`)",
    },
}
