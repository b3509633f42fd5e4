# From your plant to its parameters. Run from anywhere: sh 01_own_plant.sh
set -e
plant=$(dirname "$0")/flexible_drive.py:FlexibleDrive
folder=$(mktemp -d)
excite information $plant --excitation multisine
excite simulate $plant --excitation multisine --params J_l=0.005,c=6.5 --out $folder/record.csv
excite simulate $plant --excitation prbs --set clock=4 --params J_l=0.005,c=6.5 --out $folder/held_out.csv
excite identify $folder/record.csv --plant $plant --validate $folder/held_out.csv --plot $folder/fit.png
