"""Publish a recording sample by sample, as a rig would: python replay.py rig.csv --broker localhost --speed 10"""

import argparse
import csv
import json
import time

import paho.mqtt.client as mqtt

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("recording")
parser.add_argument("--broker", default="localhost")
parser.add_argument("--port", type=int, default=1883)
parser.add_argument("--topic", default="rig")
parser.add_argument("--speed", type=float, default=10.0, help="times faster than the recording")
arguments = parser.parse_args()

client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2, client_id="rig", clean_session=False)
client.max_queued_messages_set(0)  # samples wait without limit while the broker is away
client.connect(arguments.broker, arguments.port)
client.loop_start()
start = time.monotonic()
with open(arguments.recording, newline="") as file:
    for row in csv.DictReader(file):
        sample = {header.split("_")[0]: float(value) for header, value in row.items()}  # h1_cm is h1, in cm
        time.sleep(max(0.0, start + sample["t"] / arguments.speed - time.monotonic()))
        message = client.publish(arguments.topic, json.dumps(sample), qos=1)
message.wait_for_publish(60.0)
client.disconnect()
client.loop_stop()
