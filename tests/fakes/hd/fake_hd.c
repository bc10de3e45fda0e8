/* A stand-in for OpenHaptics' libHD.so: the HDAPI's rules, a 1 kHz servo thread, a plant, and faults.
 *
 * What is watched and injected lies in struct block (mirrored in fake_hd.py), in the file that the
 * device's name is the path of, so that it works from another process and outlives this one; a name
 * without a leading "/" leaves it private. The plant is three free joints, inertia and damping each, on the absolute angles
 * the motors act on, or, with FARHAND_FAKE_PLANT, the last two joints of that file's robot.
 */
#define _GNU_SOURCE
#include <fcntl.h>
#include <math.h>
#include <pthread.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <time.h>
#include <unistd.h>

typedef uint32_t HHD, HDenum, HDerror, HDCallbackCode, HDWaitCode, HDuint;
typedef int32_t HDint;
typedef uint16_t HDushort;
typedef unsigned char HDboolean;
typedef double HDdouble;
typedef float HDfloat;
typedef long HDlong;
typedef unsigned long HDulong, HDSchedulerHandle;
typedef const char *HDstring;
typedef HDCallbackCode (*Callback)(void *);
typedef struct { HDerror code; int32_t internal; HHD device; } HDErrorInfo;

enum { LOG = 65536, STACK = 64, TASKS = 16, DEVICE = 0, NOBODY = 0xFFFFFFFF };

enum {
    BUTTONS = 0x2000, SAFETY_SWITCH, ENCODERS = 0x2010, POSITION = 0x2050, VELOCITY,
    JOINT_ANGLES = 0x2100, GIMBAL_ANGLES = 0x2150, LAST_JOINT_ANGLES = 0x2300,
    MODEL = 0x2501, VENDOR = 0x2503, SERIAL = 0x2504, CALIBRATION_STYLE = 0x2555,
    UPDATE_RATE = 0x2600, INSTANT_RATE, MAX_STIFFNESS, MAX_FORCE, MAX_CONTINUOUS_FORCE,
    MOTOR_TEMPERATURE, FORCE = 0x2700, JOINT_TORQUE = 0x2703,
    FORCE_OUTPUT = 0x4000, ONE_FRAME_LIMIT = 0x4004,
    CALIBRATION_OK = 0x5000, CALIBRATION_NEEDS_UPDATE, ENCODER_RESET = 1
};
enum {
    INVALID_ENUM = 0x100, INVALID_VALUE, INVALID_OPERATION, INVALID_INPUT_TYPE, BAD_HANDLE,
    WARM_MOTORS = 0x200, EXCEEDED_MAX_FORCE, EXCEEDED_IMPULSE, EXCEEDED_MAX_VELOCITY, FORCE_ERROR,
    DEVICE_FAULT = 0x300, ALREADY_INITIATED, COMM_ERROR,
    ILLEGAL_BEGIN = 0x400, ILLEGAL_END, FRAME_ERROR, INVALID_PRIORITY = 0x500, SCHEDULER_FULL
};

struct block {
    /* set by tests */
    int32_t inject_error, init_error, unplugged, freeze_angles, stall_ms, period_us, warm;
    int32_t theta3_relative, needs_calibration, jump, hang_in_init;
    double value[3];              /* replaces a reported angle wherever `replace` is set */
    int32_t replace[3], buttons;
    double hand_nm[3], inertia[3], damping[3], max_velocity_rad_s;
    /* watched by tests; angle_rad and zero_rad may be set before the library is loaded */
    double angle_rad[3], velocity_rad_s[3], zero_rad[3];
    double sent_mnm[3];
    int64_t sent_ns;
    uint64_t frames, log_count;
    int32_t running, open, force_output, bad_returns, errors, left_open, reserved_2, pid;
    struct { int64_t due_ns, start_ns, end_ns, begin_ns; double sent_mnm[3]; } log[LOG];
};

struct plant { uint64_t magic, sequence; int64_t stamp_ns; uint32_t joints, flags; double position[16],
    velocity[16], wrench[6]; char gap[512 - 336]; double torque[16]; int64_t torque_stamp_ns[16]; };

struct task { HDSchedulerHandle handle; Callback call; void *data; HDushort priority; int once, done; };

static const double L1 = 0.2096, L2 = 0.1695;
static const double RESOLUTION[3] = {2 * M_PI / (4096 * 13.3), 2 * M_PI / (4096 * 11.2),
                                     2 * M_PI / (4096 * 11.2)};
static const double MAX_MNM[3] = {1720, 1445, 1445};

static struct block *block;
static volatile struct plant *plant;
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static pthread_cond_t finished = PTHREAD_COND_INITIALIZER;
static pthread_t servo;
static HDErrorInfo stack[STACK];
static int errors, stopping, in_frame, frames_this_tick, torque_set;
static struct task tasks[TASKS];
static int task_count;
static HDSchedulerHandle next_handle = 1;
static HDulong rate_hz = 1000;
static HHD current = NOBODY;
static double reported[3], last_reported[3], set_mnm[3];
static int64_t moved_ns, tick_start_ns, begin_ns;

static int64_t now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (int64_t)t.tv_sec * 1000000000 + t.tv_nsec;
}

static void *map(const char *path, size_t size) {
    int fd = path ? open(path, O_RDWR) : -1;
    void *memory = fd >= 0 ? mmap(NULL, size, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0)
                           : mmap(NULL, size, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
    if (fd >= 0) close(fd);
    if (memory == MAP_FAILED) { perror("fake libHD"); abort(); }
    return memory;
}

static void attach(const char *path) {
    block = map(path, sizeof *block);
    for (int i = 0; i < 3; i++) {
        if (block->inertia[i] == 0) block->inertia[i] = 2e-3;
        if (block->damping[i] == 0) block->damping[i] = 0.02;
    }
    if (block->max_velocity_rad_s == 0) block->max_velocity_rad_s = 60;
    block->open = block->running = block->force_output = 0; /* left so by a process that was killed */
    memset(block->sent_mnm, 0, sizeof block->sent_mnm);
    block->pid = getpid();
}

__attribute__((constructor)) static void load(void) {
    attach(NULL);
    if (getenv("FARHAND_FAKE_PLANT")) plant = map(getenv("FARHAND_FAKE_PLANT"), 4096);
}

/* ---- errors: one stack for all threads, newest first ---- */

static void push(HDerror code) {
    pthread_mutex_lock(&lock);
    if (errors == STACK) memmove(stack, stack + 1, --errors * sizeof *stack);
    stack[errors++] = (HDErrorInfo){code, -1, current};
    block->errors++;
    pthread_mutex_unlock(&lock);
}

HDErrorInfo hdGetError(void) {
    pthread_mutex_lock(&lock);
    HDErrorInfo newest = errors ? stack[--errors] : (HDErrorInfo){0, 0, NOBODY};
    pthread_mutex_unlock(&lock);
    return newest;
}

HDstring hdGetErrorString(HDerror code) { return code ? "fake error" : "no error"; }

/* ---- the plant ---- */

static void plant_read(double angle[3], double velocity[3]) {
    uint64_t before, after;
    int first = plant->joints - 2;
    angle[0] = velocity[0] = 0;
    do {
        before = plant->sequence;
        __sync_synchronize();
        for (int i = 0; i < 2; i++) {
            angle[1 + i] = plant->position[first + i];
            velocity[1 + i] = plant->velocity[first + i];
        }
        __sync_synchronize();
        after = plant->sequence;
    } while (before != after || before & 1);
}

static void move(void) {
    int64_t t = now();
    double dt = moved_ns ? fmin((t - moved_ns) * 1e-9, 5e-3) : 0;
    moved_ns = t;
    if (plant) { plant_read(block->angle_rad, block->velocity_rad_s); return; }
    double motor[3] = {block->sent_mnm[0], block->sent_mnm[1], block->sent_mnm[2]};
    if (block->theta3_relative) motor[1] -= motor[2]; /* what is conjugate to relative angles */
    for (int i = 0; i < 3; i++) {
        double *v = &block->velocity_rad_s[i];
        *v += dt * (motor[i] * 1e-3 + block->hand_nm[i] - block->damping[i] * *v) / block->inertia[i];
        block->angle_rad[i] += dt * *v;
    }
}

static void sense(void) {
    if (block->jump) { block->zero_rad[2] -= 1.0; block->jump = 0; }
    memcpy(last_reported, reported, sizeof reported);
    if (block->freeze_angles || block->unplugged) return;
    for (int i = 0; i < 3; i++) {
        double angle = block->angle_rad[i] - (i == 2 && block->theta3_relative ? block->angle_rad[1] : 0);
        reported[i] = RESOLUTION[i] * round((angle - block->zero_rad[i]) / RESOLUTION[i]);
    }
}

static void position_mm(double out[3]) { /* of an unmodified arm */
    double a3 = reported[2] + (block->theta3_relative ? reported[1] : 0);
    double r = L1 * cos(reported[1]) + L2 * sin(a3);
    out[0] = -1e3 * r * sin(reported[0]);
    out[1] = 1e3 * (L1 * sin(reported[1]) - L2 * cos(a3) + 0.11);
    out[2] = 1e3 * (0.17 - r * cos(reported[0]));
}

static void send(const double mnm[3]) {
    memcpy(block->sent_mnm, mnm, sizeof block->sent_mnm);
    block->sent_ns = now();
    if (!plant) return;
    int first = plant->joints - 2;
    for (int i = 0; i < 2; i++) {
        plant->torque[first + i] =
            1e-3 * (mnm[1 + i] - (i == 0 && block->theta3_relative ? mnm[2] : 0));
        plant->torque_stamp_ns[first + i] = block->sent_ns;
    }
}

/* ---- devices and frames ---- */

static int in_servo(void) { return block->running && pthread_equal(pthread_self(), servo); }

HHD hdInitDevice(HDstring name) {
    if (!block->open && !block->running && name && name[0] == '/') attach(name);
    while (block->hang_in_init) usleep(1000);
    if (block->init_error || block->unplugged) {
        push(block->init_error ? block->init_error : COMM_ERROR);
        return NOBODY;
    }
    if (block->open) { push(ALREADY_INITIATED); return NOBODY; }
    block->open = 1;
    move();
    sense();
    return current = DEVICE;
}

void hdDisableDevice(HHD device) {
    if (device != DEVICE || !block->open) { push(BAD_HANDLE); return; }
    block->open = block->force_output = 0;
    current = NOBODY;
}

void hdMakeCurrentDevice(HHD device) {
    if (device != DEVICE || !block->open) push(BAD_HANDLE);
    else current = device;
}

HHD hdGetCurrentDevice(void) { return current; }

void hdBeginFrame(HHD device) {
    if (device != DEVICE || !block->open) { push(BAD_HANDLE); return; }
    if (in_frame || (in_servo() && frames_this_tick)) { push(ILLEGAL_BEGIN); return; }
    in_frame = 1;
    frames_this_tick++;
    begin_ns = now();
    torque_set = 0;
    if (block->unplugged) push(COMM_ERROR);
    if (block->inject_error) { push(block->inject_error); block->inject_error = 0; }
    sense();
}

void hdEndFrame(HHD device) {
    static const double nothing[3];
    if (device != DEVICE || !block->open) { push(BAD_HANDLE); return; }
    if (!in_frame) { push(ILLEGAL_END); return; }
    in_frame = 0;
    block->frames++;
    HDerror error = block->unplugged ? COMM_ERROR : 0;
    int forcing = torque_set && block->force_output && block->running && !block->unplugged;
    for (int i = 0; i < 3 && forcing && !error; i++) {
        if (!(fabs(set_mnm[i]) <= MAX_MNM[i])) error = EXCEEDED_MAX_FORCE;
        else if (fabs(block->velocity_rad_s[i]) > block->max_velocity_rad_s) error = EXCEEDED_MAX_VELOCITY;
        else if (block->warm && set_mnm[i] != 0) error = WARM_MOTORS;
    }
    if (error) push(error);
    send(forcing && !error ? set_mnm : nothing);
}

/* ---- scheduler ---- */

static void run_task(struct task task) {
    HDCallbackCode code = task.call(task.data);
    if (code > 1) block->bad_returns++; /* garbage: taken as done */
    pthread_mutex_lock(&lock);
    for (int i = 0; i < task_count; i++)
        if (tasks[i].handle == task.handle && (task.once || code != 1)) tasks[i].done = 1;
    pthread_mutex_unlock(&lock);
}

static void *serve(void *unused) {
    (void)unused;
    int64_t due = now();
    while (!stopping) {
        int64_t period = block->period_us ? block->period_us * 1000LL : 1000000000LL / (int64_t)rate_hz;
        due += period;
        if (block->stall_ms) { due += block->stall_ms * 1000000LL; block->stall_ms = 0; }
        struct timespec wake = {due / 1000000000, due % 1000000000};
        clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &wake, NULL);
        tick_start_ns = now();
        frames_this_tick = 0;
        move();
        struct task due_now[TASKS];
        pthread_mutex_lock(&lock);
        int count = task_count;
        memcpy(due_now, tasks, sizeof due_now);
        pthread_mutex_unlock(&lock);
        for (int k = 0; k < count; k++)
            if (!due_now[k].done) run_task(due_now[k]);
        if (in_frame) { push(FRAME_ERROR); block->left_open++; in_frame = 0; }
        pthread_mutex_lock(&lock);
        int kept = 0;
        for (int k = 0; k < task_count; k++)
            if (!tasks[k].done) tasks[kept++] = tasks[k];
        task_count = kept;
        pthread_cond_broadcast(&finished);
        pthread_mutex_unlock(&lock);
        int64_t end = now();
        uint64_t k = block->log_count;
        block->log[k % LOG].due_ns = due;
        block->log[k % LOG].start_ns = tick_start_ns;
        block->log[k % LOG].end_ns = end;
        block->log[k % LOG].begin_ns = begin_ns;
        memcpy(block->log[k % LOG].sent_mnm, block->sent_mnm, sizeof block->sent_mnm);
        block->log_count = k + 1;
        if (end > due + period) due = end; /* a late tick is not made up for */
    }
    return NULL;
}

static HDSchedulerHandle schedule(Callback call, void *data, HDushort priority, int once) {
    pthread_mutex_lock(&lock);
    HDSchedulerHandle handle = 0;
    if (task_count < (int)TASKS) {
        int at = task_count++; /* highest priority first */
        for (; at > 0 && tasks[at - 1].priority < priority; at--) tasks[at] = tasks[at - 1];
        tasks[at] = (struct task){handle = next_handle++, call, data, priority, once, 0};
    }
    pthread_mutex_unlock(&lock);
    if (!handle) push(SCHEDULER_FULL);
    return handle;
}

static int pending(HDSchedulerHandle handle) {
    for (int i = 0; i < task_count; i++)
        if (tasks[i].handle == handle) return 1;
    return 0;
}

HDSchedulerHandle hdScheduleAsynchronous(Callback call, void *data, HDushort priority) {
    return schedule(call, data, priority, 0);
}

HDboolean hdWaitForCompletion(HDSchedulerHandle handle, HDWaitCode wait) {
    pthread_mutex_lock(&lock);
    while (wait && block->running && pending(handle)) pthread_cond_wait(&finished, &lock);
    HDboolean scheduled = pending(handle);
    pthread_mutex_unlock(&lock);
    return scheduled;
}

void hdScheduleSynchronous(Callback call, void *data, HDushort priority) {
    if (!block->running || in_servo()) { call(data); return; }
    HDSchedulerHandle handle = schedule(call, data, priority, 1);
    if (handle) hdWaitForCompletion(handle, 1);
}

void hdUnschedule(HDSchedulerHandle handle) {
    pthread_mutex_lock(&lock);
    int found = 0;
    for (int i = 0; i < task_count; i++)
        if (tasks[i].handle == handle) {
            found = 1;
            if (block->running) tasks[i].done = 1;
            else memmove(&tasks[i], &tasks[i + 1], (--task_count - i) * sizeof *tasks);
            break;
        }
    pthread_mutex_unlock(&lock);
    if (!found) push(INVALID_OPERATION);
}

void hdStartScheduler(void) {
    if (block->running) { push(INVALID_OPERATION); return; }
    stopping = 0;
    block->running = 1;
    pthread_create(&servo, NULL, serve, NULL);
    /* On a shared bench, before every other thread where that is allowed: hardware does not wait. */
    struct sched_param first = {.sched_priority = 85};
    if (plant) (void)!pthread_setschedparam(servo, SCHED_FIFO, &first);
}

void hdStopScheduler(void) {
    if (!block->running) { push(INVALID_OPERATION); return; }
    stopping = 1;
    pthread_join(servo, NULL);
    block->running = 0;
}

void hdSetSchedulerRate(HDulong hz) {
    if (hz != 500 && hz != 1000 && hz != 2000) push(INVALID_VALUE);
    else rate_hz = hz;
}

HDdouble hdGetSchedulerTimeStamp(void) { return (now() - tick_start_ns) * 1e-9; }

/* ---- capabilities and calibration ---- */

void hdEnable(HDenum capability) {
    if (capability < FORCE_OUTPUT || capability > ONE_FRAME_LIMIT) push(INVALID_ENUM);
    else if (current == NOBODY) push(BAD_HANDLE);
    else if (capability == FORCE_OUTPUT) block->force_output = 1;
}

void hdDisable(HDenum capability) {
    if (capability < FORCE_OUTPUT || capability > ONE_FRAME_LIMIT) push(INVALID_ENUM);
    else if (capability == FORCE_OUTPUT) block->force_output = 0;
}

HDboolean hdIsEnabled(HDenum capability) { return capability == FORCE_OUTPUT && block->force_output; }

HDenum hdCheckCalibration(void) {
    return block->needs_calibration ? CALIBRATION_NEEDS_UPDATE : CALIBRATION_OK;
}

HDenum hdCheckCalibrationStyle(void) { return ENCODER_RESET; }

void hdUpdateCalibration(HDenum style) {
    if (style != ENCODER_RESET) { push(INVALID_VALUE); return; }
    if (block->force_output) { push(INVALID_OPERATION); return; }
    for (int i = 0; i < 3; i++)
        block->zero_rad[i] =
            block->angle_rad[i] - (i == 2 && block->theta3_relative ? block->angle_rad[1] : 0);
    block->needs_calibration = 0;
}

/* Declared in the vendor's header, described nowhere: they are there, and change nothing. */
void hdUpdateCalibrationMessage(HDenum style) {
    if (style != ENCODER_RESET) push(INVALID_VALUE);
}

void hdScaleGimbalAngles(double x, double y, double z, double transform[16]) {
    (void)x; (void)y; (void)z; (void)transform;
}

HDboolean hdDeploymentLicense(const char *vendor, const char *application, const char *password) {
    return vendor != NULL && application != NULL && password != NULL;
}

/* ---- parameters ---- */

static int doubles(HDenum what, double out[6]) {
    if (current == NOBODY) { push(BAD_HANDLE); return 0; }
    if (block->running && !in_servo()) push(INVALID_OPERATION); /* state belongs in callbacks */
    switch (what) {
    case JOINT_ANGLES:
        for (int i = 0; i < 3; i++) out[i] = block->replace[i] ? block->value[i] : reported[i];
        return 3;
    case LAST_JOINT_ANGLES: memcpy(out, last_reported, sizeof last_reported); return 3;
    case GIMBAL_ANGLES: case VELOCITY: memset(out, 0, 3 * sizeof *out); return 3;
    case POSITION: position_mm(out); return 3;
    case JOINT_TORQUE: memcpy(out, set_mnm, sizeof set_mnm); return 3;
    case MOTOR_TEMPERATURE: out[0] = out[1] = out[2] = block->warm ? 1.0 : 0.2; return 3;
    case MAX_FORCE: out[0] = 8.5; return 1;
    case MAX_CONTINUOUS_FORCE: out[0] = 1.4; return 1;
    case MAX_STIFFNESS: out[0] = 0.35; return 1;
    case BUTTONS: case SAFETY_SWITCH: case ENCODERS: case CALIBRATION_STYLE: case UPDATE_RATE:
    case INSTANT_RATE: push(INVALID_INPUT_TYPE); return 0;
    default: push(INVALID_ENUM); return 0;
    }
}

static int integers(HDenum what, HDlong out[6]) {
    if (current == NOBODY) { push(BAD_HANDLE); return 0; }
    switch (what) {
    case BUTTONS: out[0] = block->buttons; return 1;
    case SAFETY_SWITCH: out[0] = 0; return 1;
    case CALIBRATION_STYLE: out[0] = ENCODER_RESET; return 1;
    case UPDATE_RATE: case INSTANT_RATE:
        out[0] = block->period_us ? 1000000 / block->period_us : (HDlong)rate_hz; return 1;
    case ENCODERS:
        for (int i = 0; i < 6; i++) out[i] = i < 3 ? lround(reported[i] / RESOLUTION[i]) : 0;
        return 6;
    default: push(what >= POSITION && what <= JOINT_TORQUE ? INVALID_INPUT_TYPE : INVALID_ENUM);
        return 0;
    }
}

#define GET(NAME, TYPE, FROM, BUFFER)                                                              \
    void NAME(HDenum what, TYPE *out) {                                                            \
        BUFFER values[6];                                                                          \
        int n = FROM(what, values);                                                                \
        for (int i = 0; i < n; i++) out[i] = (TYPE)values[i];                                      \
    }
GET(hdGetDoublev, HDdouble, doubles, double)
GET(hdGetFloatv, HDfloat, doubles, double)
GET(hdGetIntegerv, HDint, integers, HDlong)
GET(hdGetLongv, HDlong, integers, HDlong)
GET(hdGetBooleanv, HDboolean, integers, HDlong)

HDstring hdGetString(HDenum what) {
    switch (what) {
    case MODEL: return "PHANToM Premium 1.5";
    case VENDOR: return "fake";
    case SERIAL: return "0";
    default: push(INVALID_ENUM); return "";
    }
}

void hdSetDoublev(HDenum what, const HDdouble *in) {
    if (what != JOINT_TORQUE) { push(what == FORCE ? INVALID_OPERATION : INVALID_ENUM); return; }
    if (!in_frame) { push(INVALID_OPERATION); return; }
    memcpy(set_mnm, in, sizeof set_mnm);
    torque_set = 1;
}

void hdSetFloatv(HDenum what, const HDfloat *in) {
    double values[3] = {in[0], in[1], in[2]};
    hdSetDoublev(what, values);
}

void hdSetIntegerv(HDenum what, const HDint *in) { (void)what; (void)in; push(INVALID_INPUT_TYPE); }
void hdSetLongv(HDenum what, const HDlong *in) { (void)what; (void)in; push(INVALID_INPUT_TYPE); }
void hdSetBooleanv(HDenum what, const HDboolean *in) { (void)what; (void)in; push(INVALID_INPUT_TYPE); }
