"""Make buckets in the object store that are not there yet; boto3 finds address and keys in the environment."""

import sys

import boto3

client = boto3.client("s3")
there = {found["Name"] for found in client.list_buckets()["Buckets"]}
for bucket in sys.argv[1:]:
    if bucket not in there:
        client.create_bucket(Bucket=bucket)
    print(f"bucket {bucket}: there")
