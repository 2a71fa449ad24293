/* The calls of Force Dimension's library that hw/force_dimension.py makes, with the public prototypes of dhdc.h.

   The two devices, with the serial numbers 4711 and 4712, stand still. The test writes every other symbol that the
   binding looks up into a second file, as a call that fails. */
#include <string.h>

static int expert, status[2][17];
static double forces[2][3], limits[2];
static unsigned char watchdogs[2];
static int buttons[2];

void dhdGetSDKVersion(int *major, int *minor, int *release, int *revision) {
    *major = 3, *minor = 17, *release = 6, *revision = 0;
}
int dhdOpenID(signed char ID) { return ID < 2 ? ID : -1; }
int dhdOpenSerial(int serial) { return serial == 4711 ? 0 : serial == 4712 ? 1 : -1; }
int dhdClose(signed char ID) { return ID < 2 ? 0 : -1; }
int dhdGetSerialNumber(unsigned short *sn, signed char ID) { return *sn = (unsigned short)(4711 + ID), 0; }
int dhdGetSerialNumberPtr(unsigned short *sn, signed char ID) { return dhdGetSerialNumber(sn, ID); }
const char *dhdGetSystemName(signed char ID) { return ID < 2 ? "omega.3" : 0; }
const char *dhdErrorGetLastStr(void) { return "no such device"; }
int dhdEnableExpertMode(void) { return expert = 1, 0; }
int dhdSetWatchdog(unsigned char duration, signed char ID) { return expert ? (watchdogs[(int)ID] = duration, 0) : -1; }
int dhdSetMaxForce(double limit, signed char ID) { return limits[(int)ID] = limit, 0; }
int dhdEnableForce(unsigned char on, signed char ID) {
    status[(int)ID][0] = status[(int)ID][1] = 1;
    return status[(int)ID][5] = on, 0;
}
int dhdGetStatus(int out[17], signed char ID) { return memcpy(out, status[(int)ID], sizeof status[0]), 0; }
int dhdGetButton(int index, signed char ID) { return index == 0 && buttons[(int)ID]; }
int dhdGetPosition(double *x, double *y, double *z, signed char ID) { return (void)ID, *x = *y = *z = 0.0, 0; }
int dhdSetForce(double x, double y, double z, signed char ID) {
    forces[(int)ID][0] = x, forces[(int)ID][1] = y, forces[(int)ID][2] = z;
    return 0;
}
/* Calls with which the test sets the status and reads forces, limits and watchdogs. */
void stub_status(int ID, int index, int value) { status[ID][index] = value; }
void stub_button(int ID, int pressed) { buttons[ID] = pressed; }
double stub_force(int ID, int axis) { return forces[ID][axis]; }
double stub_limit(int ID) { return limits[ID]; }
int stub_watchdog(int ID) { return watchdogs[ID]; }
